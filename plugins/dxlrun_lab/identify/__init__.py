"""Identification: model of a servo and its load from a run, with confidence intervals, as a motor file.

Single figures of a servo, measured without a model, are in `characterize`.
"""
