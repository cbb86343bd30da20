"""Dynamixel servos on their serial lines: control tables, packets, ports, and the exchange of a cycle.

It is a library below the runtime and knows nothing of robots, logs or YAML. What a robot makes of servos
belongs in `dxlrun.dynamixel`.
"""
