"""Access from other computers: certificates, roles, one commander at a time, files of known robots.

Access from the same computer uses a Unix socket and none of this package's network code.
"""
