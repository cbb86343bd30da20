"""Mechanics: joints that need several servos, as one hardware of joints in front of the servos'."""
