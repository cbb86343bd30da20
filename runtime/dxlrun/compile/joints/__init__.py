"""Joints: compiles joints, their servos, limits, registers, motors and URDF.

The parent package compiles the users of joints: controllers, motions and policies.
"""
