"""Conduct of a run: requests of clients, and the behaviour of controllers and sensors.

The tracking of goals by joints belongs in `joints`, traffic on the bus in `servos`.
"""
