"""Joints of a log: tracking error, delay, movement, health, and goals that they missed.

Servos and their packets belong in `servos`.
"""
