"""Analysis of a log: latency, traffic, tracking; numbers, and a verdict in words."""
