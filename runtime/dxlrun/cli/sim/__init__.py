"""`dxlrun sim`: simulated servos on pseudo-terminals, for other programs.

The servos themselves are in `dxlsim`.
"""
