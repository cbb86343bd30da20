"""Wire: packets of both protocols from the perspective of servos: parses instructions and builds replies.

It deliberately shares no code with the packets of the host."""
