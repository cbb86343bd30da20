"""Plan: what each cycle sends and awaits on a bus, when it is due, what it costs."""
