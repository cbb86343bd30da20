"""Guided experiments: client of a run that plays tables of goals and collects the recordings.

The measurements and their sequence are in the packages of the experiments.
"""
