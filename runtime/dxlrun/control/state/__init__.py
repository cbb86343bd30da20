"""State: what the loop and its controllers know at the end of a cycle, as data."""
