"""Wire: packets of both protocols from the perspective of servos.

It deliberately shares no code with the packets of the host.
"""
