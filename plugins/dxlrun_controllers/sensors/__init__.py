"""Standard sensors, each run in a process of its own.

What controllers make of their samples belongs in `sensing`.
"""
