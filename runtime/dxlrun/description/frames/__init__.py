"""Frames: the tree of a robot's links from its URDF, and their poses at given joint positions.

Bodies that move under forces belong in the simulation.
"""
