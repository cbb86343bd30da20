"""Characterization of a servo: response, speed, dead band, rates, and gaps between commands.

A model of the servo, fitted to a run, belongs in `identify`.
"""
