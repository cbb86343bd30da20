"""Faults: what goes wrong on a simulated bus, by script or by chance."""
