"""Simulated buses on pseudo-terminals in real time, one thread for all lines, and what asks for it.

What passes on a line is decided in `bus`; ports on virtual time are in `virtual_ports`.
"""
