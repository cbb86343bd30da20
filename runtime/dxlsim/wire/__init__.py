"""Wire: packets of both protocols as servos read and write them."""
