"""Experiments: measurements of the machine, the loop and the servos, one package each.

Statistics of logs are in `dxlrun_analysis`.
"""
