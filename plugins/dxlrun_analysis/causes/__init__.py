"""Causes of late and long cycles, derived from the packets and the plan alone.

This package builds on `servos`, which pairs packets with servos. Verdicts belong in `verdict.py`.
"""
