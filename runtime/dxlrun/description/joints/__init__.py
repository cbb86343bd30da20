"""Joints in a robot file, and what moves them: mechanics, servos, and motors by files of their own."""
