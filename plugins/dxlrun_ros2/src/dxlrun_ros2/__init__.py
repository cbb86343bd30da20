"""Bridge of a running dxlrun robot to ROS 2, under the names of ros2_control.

The bridge is a client of the run, in an environment with ROS 2. Message definitions are in `interfaces/`.
"""

CLIENT = "dxlrun-ros2"
"""Name under which the robot's log records the requests of this bridge"""
