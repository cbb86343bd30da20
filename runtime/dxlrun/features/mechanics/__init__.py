"""Mechanics: joints with several servos and `transmissions`: checks, plan, and conversion during a run.

Checks and figures of a joint are the same for one servo, whose matrix is 1, for several servos, and for a
transmission. In a run, the code above the layer of this package knows only joints, and the code below only
servos. The layer is omitted if each joint has its own servo.
"""
