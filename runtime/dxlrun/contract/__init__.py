"""Contract: base classes of controllers and sensors, hooks, and the interface of the loop's hardware.

Implementations belong elsewhere: controllers in plugins/dxlrun_controllers, the hardware in `dynamixel`.
"""
