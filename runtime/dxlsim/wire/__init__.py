"""Wire: packets of both protocols as servos read and write them.

It shares no code with the packets of the host, on purpose.
"""
