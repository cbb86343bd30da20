"""Measurement of the machine's wake-up latency, with the wait of the loop (`rt_test` of the thesis).

The evaluation and the page are in `dxlrun_analysis.latency`.
"""
