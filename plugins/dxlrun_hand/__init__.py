"""Dialogues for work on a robot by hand: servo setup, joint calibration, teaching of motions.

Each dialogue asks before it writes. Commands without a dialogue belong in the core's `cli/tools`.
"""
