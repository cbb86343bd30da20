"""Forms of joints, groups, mechanics, servos and motor files.

How a joint is moved on a bus is decided in `compile/joints`.
"""
