"""Tracking experiment: tracking errors with four ways to time the commands (thesis, 5.3.3).

`dxlrun_analysis.joints` computes the tracking errors in any log.
"""
