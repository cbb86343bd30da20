"""Bodies of simulated servos, moved by MuJoCo.

The core simulates servos, motors and buses. Without this package each joint is a shaft with inertia.
"""
