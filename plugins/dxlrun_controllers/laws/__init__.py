"""Control laws as functions of arrays: PID, splines, odometry, gravity, learning, orientation filter.

A law depends neither on robots nor on controllers. Parameters, commands and messages belong to the
controllers.
"""
