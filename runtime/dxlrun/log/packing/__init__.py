"""Packing of a run's records as messages of the log, field by field.

The schemas of these messages are in `log/schemas.py`.
"""
