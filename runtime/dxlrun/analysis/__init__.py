"""What a log tells about a run: latency, bus, tracking; numbers, and a verdict in words."""
