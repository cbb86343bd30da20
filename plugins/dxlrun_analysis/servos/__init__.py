"""Buses and servos of a log: traffic, reply times, losses, broken replies, other hosts on the line.

Joints, which controllers command, belong in `joints`.
"""
