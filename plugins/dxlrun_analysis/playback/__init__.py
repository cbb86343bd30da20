"""Recorded motions: read from logs, foreign recordings and ROS 2 bags, and converted to motion files.

`dxlrun_lab` plays them on robots.
"""
