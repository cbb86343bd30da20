"""Buses and servos of a log: requests, reply times, missing and broken replies, other hosts.

Joints, which controllers command, are the subject of `joints`.
"""
