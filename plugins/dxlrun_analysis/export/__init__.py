"""A log in other formats: CSV, Parquet, a LeRobot data set."""
