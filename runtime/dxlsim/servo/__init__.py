"""Servo: instructions and protection of a simulated servo.

How its shaft moves belongs in `motion`.
"""
