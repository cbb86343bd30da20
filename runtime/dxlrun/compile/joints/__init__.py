"""Joints: bus, model, limits, registers and motors of each, checked and made ready."""
