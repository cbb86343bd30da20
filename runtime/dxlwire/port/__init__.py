"""Serial ports: opened, locked, reopened, with the latency timer of their adapter.

Packets do not belong here: a port carries bytes.
"""
