"""Server for Foxglove and Lichtblick: a running robot over their WebSocket protocol.

Logs need no server, because both programs open MCAP files.
"""
