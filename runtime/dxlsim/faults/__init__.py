"""Faults: what goes wrong on a simulated bus, by script or by chance.

A fault changes bytes, times or registers; how the runtime reacts is none of its business.
"""
