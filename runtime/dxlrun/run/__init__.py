"""Run: the processes of a robot, from the terminal to the loop."""
