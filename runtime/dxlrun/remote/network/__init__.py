"""Access from other computers: certificates, roles, one commander at a time, files of known robots.

On the same computer a Unix socket is used, and nothing here.
"""
