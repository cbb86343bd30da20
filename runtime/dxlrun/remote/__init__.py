"""Remote access: the gateway, a process next to the loop, and the Python client that talks to it.

Commands at the terminal belong in `cli/steering`. Decisions of the loop belong in `control`.
"""
