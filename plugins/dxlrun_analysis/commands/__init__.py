"""Commands for logs: what they say, what they become."""
