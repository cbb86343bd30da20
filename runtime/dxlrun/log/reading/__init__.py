"""Parts of the reader: chunks, topics, slices of a run, columns.

Files are opened by `log/reader.py`. Computations on columns belong to their callers.
"""
