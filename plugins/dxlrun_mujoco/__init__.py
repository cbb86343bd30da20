"""Bodies of simulated servos, moved by MuJoCo.

Servos, motors and buses are simulated by the core; without this package each joint is a shaft with inertia.
"""
