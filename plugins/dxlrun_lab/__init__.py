"""Commands that measure the machine, the loop and the servos, or replay logs; one package per experiment.

Statistics of logs are in `dxlrun_analysis`.
"""
