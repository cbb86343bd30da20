"""Commands about servos on a port, and about models."""
