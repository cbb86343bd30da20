"""Control laws as functions of arrays: PID, splines, odometry, gravity, learning, orientation filter.

A law knows neither robots nor controllers. Parameters, commands and messages belong to the controllers.
"""
