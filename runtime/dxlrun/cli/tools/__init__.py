"""Commands for servos and devices on a port that no run uses, and their models."""
