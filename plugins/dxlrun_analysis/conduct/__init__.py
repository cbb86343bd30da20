"""Conduct of a run: what clients requested, and what controllers and sensors did.

How well joints followed their goals belongs in `joints`, traffic on the bus in `servos`.
"""
