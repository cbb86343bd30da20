"""Experiments: measurements of the machine, the loop and the servos, one package each.

Statistics of any log belong in `dxlrun_analysis`.
"""
