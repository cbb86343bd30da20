"""Dynamixel: reads, commands and supervises the servos and devices of a robot, from joint states and goals
down to transactions on a bus.

Packets, serial ports and control tables are in the library `dxlwire`.
"""
