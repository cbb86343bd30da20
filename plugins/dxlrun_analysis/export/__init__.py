"""Exports of a log: CSV, Parquet, LeRobot data sets.

All formats are written from the same tables (`tables.py`). The logs of many runs belong in `season`.
"""
