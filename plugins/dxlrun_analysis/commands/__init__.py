"""Commands that read logs: `analyze`, `export`, `logs`.

They parse options and print. What they print is computed in the other packages.
"""
