"""Channels: what crosses between processes, and the shared memory in which it does."""
