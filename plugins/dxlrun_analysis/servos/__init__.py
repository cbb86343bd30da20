"""Buses and servos in a log: traffic, reply times, errors, health."""
