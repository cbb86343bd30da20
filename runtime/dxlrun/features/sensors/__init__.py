"""Sensors: sources of states that are not on a servo bus; each is sampled by a process of its own.

The class of a sensor is in `driver.py`; nodes on a servo bus are in `devices`.
"""
