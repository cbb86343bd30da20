"""Recording: the section about the log: its directory, how it is split, and what is kept.

What writes and deletes logs by its plan belongs to `log/` and `run/`.
"""
