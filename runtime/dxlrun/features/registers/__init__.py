"""The key `registers` of servos: items of their control tables that the robot file declares.

It has the form, the checks and what a start does with declared values. Which items may be written at all, and
as what, is in `compile.joints.register_values`: clients and tools ask that, too.
"""
