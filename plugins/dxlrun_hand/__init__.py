"""By hand: servos that get their addresses, joints that are measured, motions that are shown to the robot."""
