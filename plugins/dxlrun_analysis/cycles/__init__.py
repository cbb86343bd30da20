"""Cycles of the control loop in a log: wake-up times, durations of their steps, and the worst cycles.

The causes of late and long cycles are determined in `causes`.
"""
