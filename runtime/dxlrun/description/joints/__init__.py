"""Forms of joints, groups of joints, their mechanics and servos, and of motor files.

`compile/joints` decides how servos on a bus move a joint.
"""
