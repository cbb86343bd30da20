"""A running dxlrun robot in ROS 2, under the names of ros2_control."""

CLIENT = "dxlrun-ros2"
"""Its name in the robot's log."""
