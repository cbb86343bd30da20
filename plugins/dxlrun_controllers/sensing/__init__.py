"""Controllers that compute messages, states and decisions from the states of devices and sensors.

The sensors' drivers are in `sensors`.
"""
