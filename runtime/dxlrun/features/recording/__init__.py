"""Recording: the section `recording` of a robot file: the log's directory, its parts, and what to keep.

`log/` and `run/` write and delete logs according to its plan.
"""
