"""The key `registers` of servos: items of their control tables that the robot file declares.

It contains the form and the checks; start-up writes the declared values. `compile.joints.register_values`
decides which items can be written, because clients and tools use it, too.
"""
