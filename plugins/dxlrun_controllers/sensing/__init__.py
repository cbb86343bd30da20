"""Controllers that compute messages, states and decisions from the states of devices and sensors.

The drivers are in `sensors`.
"""
