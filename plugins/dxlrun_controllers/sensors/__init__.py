"""Standard sensors. Each runs in a process of its own.

The controllers that use their samples are in `sensing`.
"""
