"""Evaluation of a latency measurement: statistics, tables, page.

The measurement itself is in `dxlrun_lab.latency`.
"""
