"""Simulated servos on simulated buses, with packet code of their own; they share only the control tables."""
