"""Parts of the report: each module computes numbers of a log for `--json`, and the table that shows them.

Plots belong in `page/`, data of the verdict alone in the folder of their subject. `report.py` has the order.
"""
