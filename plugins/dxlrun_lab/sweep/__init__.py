"""Sweep: one motion of a robot at many values of its robot file, on virtual time, each run scored."""
