"""Buses and servos of a log: their requests and replies, reply times, missing and broken replies, other
hosts.

Joints, which controllers command, are the subject of `joints`.
"""
