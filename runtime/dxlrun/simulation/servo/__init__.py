"""Servo: memory, instructions and protection of a simulated servo."""
