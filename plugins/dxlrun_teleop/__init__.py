"""Teleoperation: a running robot is driven from a keyboard or a gamepad, as long as a hand says so."""
