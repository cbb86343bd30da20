"""Parts of the report: each module has numbers of a log, for `--json`, with the table that shows them.

Plots belong to `page/`, what only the verdict reads to the folder of its subject. `report.py` has the order.
"""
