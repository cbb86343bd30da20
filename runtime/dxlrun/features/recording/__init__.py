"""Recording: the section about the log: its directory, its parts, and the logs to keep.

`log/` and `run/` write and delete logs according to its plan.
"""
