"""Exports of a log to other formats: CSV, Parquet, LeRobot data sets.

CSV and Parquet are written from the same tables (`tables.py`). The logs of many runs belong in `season`.
"""
