"""Frames: the tree of a robot's links from its URDF, and their poses for given joint positions.

Bodies that move by forces belong in the simulation.
"""
