"""Packing: converts records of a run into encoded messages of the log.

The schemas of these messages are in `log/schemas.py`.
"""
