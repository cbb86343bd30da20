"""Contract: base class of controllers, hooks, and the interface of the loop's hardware.

The base class of sensors is in `features/sensors/driver.py`. Implementations belong elsewhere: controllers in
plugins/dxlrun_controllers, the hardware in `dynamixel`.
"""
