"""Contract: base classes of controllers and sensors, the hooks, and the interface of the loop's hardware.

Implementations do not belong here: controllers are in plugins/dxlrun_controllers, the hardware is in
`dynamixel`.
"""
