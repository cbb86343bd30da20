"""Control: the loop and what it calls in each cycle (steering, controllers, gate, policies).

Nothing here knows servos or bytes: it sees the arrays of the cycle's record and the interface of the
hardware.
"""
