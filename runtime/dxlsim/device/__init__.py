"""Simulated devices: what is on a simulated line and is no servo."""
