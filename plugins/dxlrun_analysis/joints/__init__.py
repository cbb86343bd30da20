"""Joints of a log: tracking error, delay, movement, temperature and voltage, and failures to follow commands.

Servos and their packets are the subject of `servos`.
"""
