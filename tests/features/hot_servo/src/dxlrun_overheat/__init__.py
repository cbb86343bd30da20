"""Policy for overheated servos: the example of a policy with steps that end the run."""
