"""Stale commands: reaction of a run to a client whose stream of commands stops.

`control/steering.py` detects that, because a command may come in the cycle in which its lease expires.
"""
