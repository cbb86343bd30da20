"""Registers: the memory of a simulated servo or device, and which writes it refuses."""
