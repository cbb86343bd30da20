"""Sensors: what is not on a servo bus, sampled by a process of its own."""
