"""Controllers that play motions: trajectories, keyframes, samples, iterative learning.

Controllers that follow a single goal are in the package above.
"""
