"""Simulated buses on pseudo-terminals in real time, one thread for all lines, with the interface to its
starter.

The behaviour of a line belongs in `bus`; ports on virtual time are in `virtual_ports`.
"""
