"""Recorded motions, read from logs, foreign recordings and ROS 2 bags, and written as motion files.

`dxlrun_lab` runs robots with them.
"""
