"""Joints in a log: how they followed what was sent."""
