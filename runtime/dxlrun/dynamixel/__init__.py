"""Dynamixel: servos and devices on their buses, from bytes on the wire to states and goals of joints."""
