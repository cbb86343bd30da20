"""Compilation of joints: their buses, models, limits, registers and motors.

The parent package compiles the users of joints: controllers, motions and policies.
"""
