"""Sensors: sources of states that a process of their own samples.

The class of a sensor is in `contract`, and what is on a servo bus in `devices`.
"""
