"""What acts on a robot from outside: hands and obstacles, weights, supplies, tools, and what an IMU sees."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from tests.analysis.stranger.kit import Spec, Story, instead

from dxlsim.servo.simulated_servo import SimulatedServo


def carry(story: Story, joint: str, torque_nm: float) -> None:
    """Let a joint carry a weight from now on, or none."""
    shaft = story.servo(joint).shaft
    shaft.mechanics.plant._gravity[shaft.index] = torque_nm
    shaft.mechanics.plant._has_gravity = True
    shaft.mechanics._wake()
    story.evidence["weight changed"] += 1


def poke(story: Story, joint: str, **items: int) -> None:
    """Set those of some registers that a joint's servo has, as a tool would, now."""
    servo = story.servo(joint)
    for name, value in items.items():
        if name in servo.registers:
            servo.poke(name, value)
            story.evidence["registers changed"] += 1


def set_before(story: Story, joint: str, **items: int) -> None:
    """Set those of some registers that a joint's servo has, before the program connects to it."""
    story.prepared.append(lambda: poke(story, joint, **items))


def supply(
    story: Story,
    joint: str | int,
    volts: Callable[[float, SimulatedServo], float | None],
    kind: str,
    since_s: float = 0.9,
) -> None:
    """Give the servos of a joint's bus another voltage (V), by time (s) and servo; None: as it is."""

    def give(t_s: float) -> None:
        for servo in story.bus(joint).servos:
            given = volts(t_s, servo)
            if given is not None:
                story.evidence[kind] += 1
                servo.voltage = given
                servo.apply_protection()

    story.every(0.02, give, joint, since_s)


def voltages_often(story: Story) -> None:
    """Let the voltages be read ten times a second."""
    item = "present_voltage" if story.kind.protocol == 1.0 else "present_input_voltage"
    for bus in story.spec["buses"].values():
        bus["slow_registers"] = {"rate": 10, "items": [item]}


def noisy_imu(story: Story) -> None:
    """Give the IMU the noise that a real one has."""
    story.spec["sensors"]["gyro"] |= {
        "gyroscope": {"noise_density": 1.0e-3},
        "accelerometer": {"noise_density": 3.0e-3},
    }


def imu_gives(story: Story, change: Callable[[float, np.ndarray[Any, Any]], None]) -> None:
    """Change what the IMU gives, in place, by the time (s)."""

    def changed(read: Callable[[Any], int], values: Any) -> int:
        t_ns = read(values)
        change(story.now_s(), values)
        return t_ns

    imu_reads(story, changed)


def imu_reads(story: Story, given: Callable[[Callable[[Any], int], Any], int]) -> None:
    """Let `given` read the IMU: it gets how it is read and the values to fill, and returns their time, ns."""
    story.prepared.append(
        lambda: instead(story.virtual.drivers["gyro"], "read", lambda read: partial(given, read))
    )


def read_slowly(story: Story, hertz: int = 4) -> None:
    """Let temperatures and voltages be read some times a second."""
    for bus in story.spec["buses"].values():
        bus["slow_registers"] = {"rate": hertz}


def foot_board(story: Story) -> None:
    """Give the robot a board in its foot whose four forces tremble by some steps."""
    if story.kind.protocol == 1.0:
        model, middle, noise = "OP-FSR", 4.0, 0.02
        cells = [f"force.{number}" for number in range(1, 5)]
    else:
        model, middle, noise = "bitbots-foot", 80_000.0, 400.0
        cells = [f"pressure.{side}_{end}" for side in ("left", "right") for end in ("front", "back")]
    forces: Spec = {
        "values": {cell: middle * (1 + 0.1 * place) for place, cell in enumerate(cells)},
        "noise": dict.fromkeys(cells, noise),
    }
    story.spec["devices"] = {"foot": {"bus": "main", "id": 101, "model": model, "simulation": forces}}
