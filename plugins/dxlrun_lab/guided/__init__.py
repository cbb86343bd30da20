"""Guided experiments: a client of a run that plays tables of goals and collects what was recorded.

What is measured, and in which order, belongs in the package of the experiment.
"""
