"""Control: the control loop and the modules it calls in each cycle: steering, controllers, gate, policies.

This package does not depend on servos or protocols. It works on the arrays of the cycle's record and on the
hardware interface.
"""
