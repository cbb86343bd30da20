"""Standard sensors, whose drivers run in a process of their own.

The controllers that use their samples are in `sensing`.
"""
