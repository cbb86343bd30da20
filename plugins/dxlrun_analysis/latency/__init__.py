"""Evaluation of a measurement by `dxlrun latency`: log, statistics, tables, page.

The measurement itself is in `dxlrun_lab.latency`.
"""
