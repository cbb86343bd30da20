"""Commands to a running robot: `send`, `list`, `get`, `watch`, `torque`, `switch` and others.

They are clients of the robot's gateway (`remote`) and never open a serial port.
"""
