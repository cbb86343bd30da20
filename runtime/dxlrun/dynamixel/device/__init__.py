"""Devices: units on a bus that are not servos: checked at start, read each cycle, commanded.

Sensors with a line of their own belong in `control/sensors`.
"""
