"""Playback: recorded motions of logs, foreign recordings and ROS 2 bags, for robots and motion files."""
