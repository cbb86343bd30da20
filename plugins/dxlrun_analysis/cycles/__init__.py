"""Cycles of a log: wake-up times, durations of their steps, the worst of them.

Why a cycle was late belongs in `causes`.
"""
