"""Wire: packets of both protocols and bytes, without I/O."""
