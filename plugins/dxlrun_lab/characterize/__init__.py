"""Characterization of a servo: response, speed, dead band, rates, and gaps between commands.

Models that are fitted to a run are in `identify`.
"""
