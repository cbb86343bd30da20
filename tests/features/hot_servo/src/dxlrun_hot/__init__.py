"""Policy for hot servos: the example of a policy of a package."""
