"""What a measurement of latency says: its log, its statistics, its page."""
