"""Teleoperation: drive a running robot by keyboard or gamepad while a key or a button is held.

The controllers and the gate of the robot check and limit the commands.
"""
