"""Teleoperation: drive a running robot by keyboard or gamepad while a key or a trigger is held.

What the robot makes of the commands is decided by its controllers and its gate.
"""
