"""Channels between processes: rings, slots, mailbox, heartbeat, sockets, and the records in them.

Every record that crosses has its type here. What a process does with it belongs in the room of that process.
"""
