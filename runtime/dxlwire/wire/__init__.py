"""Wire: packets of both protocols as bytes, and the receiver that finds packets among noise.

No I/O and no control tables here."""
