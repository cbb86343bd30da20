"""Simulated devices: units on a simulated line that are not servos.

They use the memory of servos (`registers`).
"""
