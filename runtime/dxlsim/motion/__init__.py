"""Motion: motors, gains, loads and bodies of simulated servos."""
