"""Controllers that turn states of devices and sensors into messages, states and decisions.

Drivers that produce these states belong in `sensors`.
"""
