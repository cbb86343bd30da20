"""The key `registers` of servos: items of their control tables that the robot file declares.

It contains the form, the checks, and the items reserved for dxlrun, which neither a robot file nor a client
can change. Start-up writes the settings of all features.
"""
