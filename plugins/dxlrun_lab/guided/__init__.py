"""Guided experiments: a client of a run plays tables of goals on joints, and records the run's cycles.

The measurements and their sequence are in the packages of the experiments.
"""
