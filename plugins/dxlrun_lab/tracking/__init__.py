"""Tracking experiment: how well a motion is followed by four ways to time its commands (thesis, 5.3.3).

How well a joint followed in any log is computed by `dxlrun_analysis.joints`.
"""
