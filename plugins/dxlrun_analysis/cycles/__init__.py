"""Cycles of a log: wake-up times, durations of their steps, and the worst cycles.

Causes of late cycles belong in `causes`.
"""
