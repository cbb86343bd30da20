"""Dynamixel servos on their serial lines: control tables, packets, ports, and the exchange of a cycle.

It knows nothing of robots, of logs or of YAML.
"""
