"""Stale commands: what a run does when a client's stream of commands stops.

`control/steering.py` finds that, because a command may come in the cycle in which its lease runs out.
"""
