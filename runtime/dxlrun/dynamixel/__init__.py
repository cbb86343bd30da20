"""Dynamixel: the servos and devices of a robot, from states and goals of joints down to transactions.

Packets, ports and control tables are a library of their own, `dxlwire`.
"""
