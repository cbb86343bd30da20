"""Sensors: measure beside the buses, each in a process of its own, and never let the loop wait."""
