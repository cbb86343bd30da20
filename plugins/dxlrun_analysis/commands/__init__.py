"""Commands that read logs: `analyze`, `export`, `logs`.

They parse options and print results that the other packages compute.
"""
