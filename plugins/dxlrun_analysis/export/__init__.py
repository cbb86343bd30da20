"""A log in other formats: CSV, Parquet, a bag directory of ROS 2, a data set of LeRobot."""
