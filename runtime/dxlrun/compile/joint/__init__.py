"""Joints of a robot file against models, limits, registers and URDF."""
