"""Registers: the key `registers` of servos, with values for items of their control tables.

It contains the form, the checks, and the items reserved for dxlrun, which neither a robot file nor a client
can change. Start-up writes the settings of all features.
"""
