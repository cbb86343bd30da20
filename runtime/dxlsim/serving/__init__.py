"""Serving: simulated buses on pseudo-terminals in real time, one thread for all lines."""
