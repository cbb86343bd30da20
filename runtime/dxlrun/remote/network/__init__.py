"""Beyond one computer: certificates, connections that begin, a client's link, the file that names robots."""
