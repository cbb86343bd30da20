"""Devices: units on a servo bus that are not servos, with states, commands and safe values.

Their tables, reads and packets are in `dxlwire`, and sensors that have a process of their own in `sensors`.
"""
