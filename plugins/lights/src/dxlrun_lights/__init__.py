"""A section of the robot file: LEDs of servos, as lights with names.

It has the files of a feature and imports only public names. Lamps with a driver of their own are devices.
"""
