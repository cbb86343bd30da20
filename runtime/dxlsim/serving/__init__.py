"""Serving: simulated buses on pseudo-terminals in real time, one thread for all lines, with the interface to
the program that started it.

The behaviour of a line belongs in `bus`; ports on virtual time are in `virtual_ports`."""
