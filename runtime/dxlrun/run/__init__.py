"""Run: the processes of a robot, from the terminal to the loop, in real and virtual time.

The steps of a cycle belong in `control`.
"""
