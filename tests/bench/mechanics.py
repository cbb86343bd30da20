"""How long a step of the simulated servos' mechanics takes.

    python tests/bench/mechanics.py

The bound: a step of 2 ms in less than 40 us, for 8 and for 20 servos that all move under load.
"""

from __future__ import annotations

import time

from dxlrun.dynamixel.control_table import control_table
from dxlrun.simulation import Load, ServoConfig
from dxlrun.simulation.motion.mechanics import STEP_NS, Mechanics
from dxlrun.simulation.servo.making import make_servo

STEPS = 2000


def step_us(count: int, model: str, protocol: float, speed_item: str) -> float:
    """Return the shortest mean time of a step in five tries, us."""
    mechanics = Mechanics(0)
    load = Load(inertia=0.002, friction=0.02, gravity=0.1)
    table = control_table(model, protocol)
    servos = [
        make_servo(ServoConfig(1, model, 1.0, load=load), 1_000_000, 0, None, protocol, mechanics=mechanics)
        for _ in range(count)
    ]
    best = float("inf")
    for attempt in range(1, 6):
        for servo in servos:
            servo.poke(speed_item, 10)
            servo.poke("torque_enable", 1)
            servo.poke("goal_position", table.max_tick * (attempt % 2))
        mechanics.advance(mechanics.grid_ns + 10 * STEP_NS)
        start = time.perf_counter()
        mechanics.advance(mechanics.grid_ns + STEPS * STEP_NS)
        best = min(best, (time.perf_counter() - start) / STEPS * 1e6)
    return best


def main() -> None:
    """Print the figures."""
    for count, model, protocol, speed in (
        (8, "AX-12A", 1.0, "moving_speed"),
        (20, "AX-12A", 1.0, "moving_speed"),
        (8, "XM430-W350", 2.0, "profile_velocity"),
        (20, "XM430-W350", 2.0, "profile_velocity"),
        (20, "XL430-W250", 2.0, "profile_velocity"),
    ):
        print(f"{count:2} x {model:10} {step_us(count, model, protocol, speed):6.1f} us a step")


if __name__ == "__main__":
    main()
