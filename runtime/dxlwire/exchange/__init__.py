"""Exchange: executes the transactions of a bus: reads and goals of each cycle, and programs in idle time.

A compiled kernel executes cycles as planned, a parser in Python everything else. The plan decides which
packets are sent, and when. The life cycle of a servo belongs in the runtime."""
