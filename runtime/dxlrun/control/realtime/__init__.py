"""Real time: what the operating system is asked for, and what it grants."""
