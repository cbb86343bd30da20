"""A running dxlrun robot in ROS 2, under the names of ros2_control.

It is a client of the run, in an environment with ROS 2. Message definitions are in `interfaces/`.
"""

CLIENT = "dxlrun-ros2"
"""Its name in the robot's log."""
