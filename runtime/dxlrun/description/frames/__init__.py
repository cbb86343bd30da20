"""Frames: the tree of a robot's links from its URDF, and the pose of each link at given joint positions.

Bodies that move under forces belong in the simulation.
"""
