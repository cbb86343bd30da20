"""Recorded motions, read from logs, foreign recordings and ROS 2 bags, and written as motion files.

Running a robot with them is not here: `dxlrun_lab` does that.
"""
