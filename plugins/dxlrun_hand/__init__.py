"""Work at the robot, by hand: set servos up, calibrate joints, teach motions.

Each is a dialogue that asks before it writes. Commands without a dialogue belong in the core's `cli/tools`.
"""
