"""What clients may ask of a running robot, and what it answers."""
