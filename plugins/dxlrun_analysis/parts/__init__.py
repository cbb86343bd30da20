"""Parts of the report of `dxlrun analyze`: each computes numbers of a log for `--json`, and their table.

Plots belong in `page/`, data of the verdict alone in the folder of their subject. `report.py` has the order.
"""
