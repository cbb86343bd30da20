"""Reading of a log below its reader: chunks, topics, slices of a run, columns.

Files are opened by `log/reader.py`. What is computed from columns belongs to its caller.
"""
