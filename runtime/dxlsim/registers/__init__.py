"""Registers: memory of a simulated servo or device, and the rules by which it rejects writes.

Names, addresses and units come from the control tables."""
