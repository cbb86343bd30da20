"""Sensors: sources of states, each sampled by its own process.

The class of a sensor is in `driver.py`; nodes on a servo bus are in `devices`.
"""
