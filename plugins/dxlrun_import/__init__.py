"""Files of other programs: named where dxlrun is given one, and converted to robot and motion files.

Each format is one module in `formats`. Recordings with MCAP or in ROS 2 bags belong in `dxlrun_analysis`.
"""
