"""A section of the robot file: LEDs of servos, as lights with names.

The package has the files of a feature and imports only public names. Lamps with their own driver are devices.
"""
