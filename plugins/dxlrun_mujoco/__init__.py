"""Bodies of simulated servos, moved by MuJoCo."""
