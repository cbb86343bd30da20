"""Exchange: reads, goals and idle work of a bus, by kernel and parser."""
