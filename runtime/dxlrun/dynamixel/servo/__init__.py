"""Servo: a servo's life from torque on to torque off, its loss and return."""
