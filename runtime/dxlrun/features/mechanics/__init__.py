"""Mechanics: how servos move joints, from the section `transmissions` to the hardware of joints.

Checks and figures of a joint are the same for one servo, whose matrix is 1, for several, and for a
transmission. In a run, only joints are known above the layer of this package, and only servos below it; it is
absent where each servo has a joint of its own.
"""
