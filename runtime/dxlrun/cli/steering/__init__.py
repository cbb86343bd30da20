"""Commands to a running robot."""
