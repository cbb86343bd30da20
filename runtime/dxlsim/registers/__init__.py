"""Registers: memory of a simulated servo or device, and the rules for rejected writes.

Names, addresses and units come from the control tables.
"""
