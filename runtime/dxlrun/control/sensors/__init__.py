"""Sensors in a run: what plug-ins offer, samples in shared slots, and their states in the cycle's record.

Devices on a servo bus are not sensors: they are read with the servos.
"""
