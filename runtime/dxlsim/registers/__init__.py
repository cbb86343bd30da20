"""Registers: the memory of a simulated servo or device, and which writes it refuses.

Names, addresses and units come from the control tables.
"""
