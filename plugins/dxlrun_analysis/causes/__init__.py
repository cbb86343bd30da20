"""Causes of late and long cycles of the control loop, derived from the packets and the plan in a log.

This package builds on `servos`, which pairs requests with replies. Rules of the verdict about other parts
belong in `verdict.py`.
"""
