"""Beyond one computer: certificates, roles and one commander, connections, files of robots and requests."""
