"""Simulated devices: units on a simulated line that are not servos.

Their memory is that of servos (`registers`).
"""
