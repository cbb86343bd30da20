"""`dxlrun sim`: simulated servos for other programs."""
