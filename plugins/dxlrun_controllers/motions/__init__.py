"""Controllers that play motions: trajectories, keyframes, tables of samples, and iterative learning.

Controllers that follow a single setpoint are in the parent package.
"""
