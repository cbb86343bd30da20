"""Ledger: a log beside what the simulated servos saw."""
