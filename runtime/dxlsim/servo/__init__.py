"""Servo: instructions, registers and protection of a simulated servo.

The motion of its shaft belongs in `motion`."""
