"""Memory: control tables of simulated servos, and what may be written to them."""
