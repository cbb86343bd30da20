"""`dxlrun sim`: simulated servos for other programs, on pseudo-terminals.

The servos themselves are in `dxlsim`.
"""
