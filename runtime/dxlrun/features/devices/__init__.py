"""Devices: nodes on a servo bus that are not servos, such as IMU boards: states, commands, safe values.

Their tables, reads and packets are in `dxlwire`. Sensors that have their own process are in `sensors`.
"""
