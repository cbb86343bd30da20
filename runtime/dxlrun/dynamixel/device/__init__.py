"""What is on a bus and is no servo: checked at the start, read each cycle, lost and found, commanded."""
