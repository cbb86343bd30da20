"""Many logs: the runs of a season as tables, in a folder or an object store, and queries on them.

The analysis of one log belongs in the packages next to this one.
"""
