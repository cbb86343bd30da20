"""What a running robot shows: the states of its newest cycle, and streams of messages."""
