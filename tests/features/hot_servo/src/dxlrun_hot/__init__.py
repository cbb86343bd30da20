"""Policies for hot servos: the examples of policies of a package."""
