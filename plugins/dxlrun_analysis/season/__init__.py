"""Tables of many logs, one row per run: in a directory or an object store, with queries on them.

The analysis of one log belongs in the packages next to this one.
"""
