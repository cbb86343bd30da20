"""Behaviour of the robot, its controllers and sensors in a run, and requests of clients.

The tracking of goals by joints belongs in `joints`, traffic on the bus in `servos`.
"""
