"""Packets of both protocols as bytes, and the receiver that finds packets in noise.

Nothing here does I/O or knows control tables.
"""
