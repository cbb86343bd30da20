"""Lost servos: reaction of a run to servos that do not answer, by policies of the robot and of its groups.

`dynamixel` recovers a lost servo.
"""
