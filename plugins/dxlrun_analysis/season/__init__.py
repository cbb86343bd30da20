"""Two logs and many: what differs between runs, and the logs of a season as tables."""
