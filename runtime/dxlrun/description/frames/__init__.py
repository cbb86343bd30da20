"""Frames: the tree of a robot's links from its URDF, and where its joints put them."""
