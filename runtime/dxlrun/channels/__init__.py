"""Channels between processes: rings, slots, mailbox, heartbeat, sockets, and the records in them.

This package declares the type of every record that crosses a process boundary. Code that produces or consumes
the records belongs to the package of the process.
"""
