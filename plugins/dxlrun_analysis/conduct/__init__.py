"""Conduct of a run: requests of clients, and the behaviour of controllers and sources.

The tracking of goals by joints belongs in `joints`, traffic on the bus in `servos`.
"""
