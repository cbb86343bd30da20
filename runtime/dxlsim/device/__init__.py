"""Simulated devices: units on a simulated line that are not servos, such as IMUs.

They use the memory of servos (`registers`)."""
