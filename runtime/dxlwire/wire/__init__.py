"""Packets of both protocols as bytes, and the receiver that finds packets in noise.

No I/O and no control tables here.
"""
