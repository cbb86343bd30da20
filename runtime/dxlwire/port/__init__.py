"""Serial ports: opening, locking and reopening of lines, and the latency timer of the adapter.

Packets do not belong here: a port carries bytes."""
