"""Serial ports: opening, locking and reopening, with the latency timer of the adapter.

Packets do not belong here: a port carries bytes.
"""
