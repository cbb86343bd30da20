"""Servo: instructions and protection of a simulated servo."""
