"""Motion: motors, control loops, loads and bodies of simulated servos.

Instructions and registers do not belong here."""
