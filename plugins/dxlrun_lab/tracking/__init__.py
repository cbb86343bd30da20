"""Tracking: how well a motion is followed, by four ways to time its sending (thesis, section 5.3.3)."""
