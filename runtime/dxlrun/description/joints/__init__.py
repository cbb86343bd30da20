"""Forms of joints, groups, mechanics, servos and motor files.

`compile/joints` decides how servos on a bus move a joint.
"""
