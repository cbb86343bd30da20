"""Run: the processes of a robot, from the terminal to the loop, on both clocks.

What happens in a cycle belongs in `control`.
"""
