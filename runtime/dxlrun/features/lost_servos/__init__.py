"""Lost servos: what a run does when servos do not answer, by policies of the robot and of its groups.

How a lost servo is found again is in `dynamixel`.
"""
