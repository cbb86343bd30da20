"""Reading: chunks, slices, topics and columns of a log, for `log/reader.py`.

Files are opened by `log/reader.py`. Computations on columns belong to their callers.
"""
