"""Joints of constructed arrays: what they were to do and what they did, and what is found of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from dxlrun.channels.cycle import Torque
from dxlrun_analysis.finding import Finding
from dxlrun_analysis.joints.movement import Movement
from dxlrun_analysis.joints.planned import PlannedJoint

Floats = npt.NDArray[np.float64]
DT = 0.02
TIME = np.arange(600) * DT  # 12 s
FAULT = TIME >= 5.0
SWING = 0.8 * np.sin(3.5 * TIME)
LOAD = 0.2 + 0.1 * np.sin(7 * TIME)
TICK = 0.005
FIELDS = ("position", "velocity", "effort", "goal_effort", "goal_position", "reference")


def behind(way: Floats, cycles: int = 2, gain: float = 1.0) -> Floats:
    """A joint that follows its way some cycles late, and in part."""
    return gain * np.concatenate([np.full(cycles, way[0]), way[:-cycles]])


def since_fault(position: Floats | float, before: Floats | float = behind(SWING)) -> Floats:  # noqa: B008  a constant
    """Something from 5 s on, and something else before; without one, a joint that follows."""
    return np.where(FAULT, position, before)


@dataclass
class Joint:
    """What a joint was to do, and what it did."""

    way: Floats = field(default_factory=lambda: SWING)
    position: Floats = field(default_factory=lambda: behind(SWING))
    load: Floats | float = field(default_factory=lambda: LOAD)
    torque: Any = Torque.ON
    velocity: float = 1.0  # NaN: not read
    planned: dict[str, Any] = field(default_factory=dict)
    effort: Floats | float = math.nan  # what a controller moves it with
    sought: Floats | float = math.nan  # where that controller is to move it


def findings(*joints: Joint, names: Sequence[str] = ()) -> list[Finding]:
    """Judge joints; all others beside them follow well."""
    count = len(joints)
    kind = [("read_ns", np.int64), *((name, np.float64, count) for name in FIELDS)]
    kind += [("age_ns", np.int64, count), ("torque", np.uint8, count), ("valid", np.bool_, count)]
    cycles = np.zeros(len(TIME), kind)
    cycles["read_ns"], cycles["valid"] = 10**9 + (TIME * 1e9).astype(np.int64), True
    planned = []
    for row, joint in enumerate(joints):
        tick = joint.planned.get("tick", TICK)
        position = np.round(joint.position / tick) * tick
        velocity = joint.velocity * np.gradient(joint.position, DT)
        values = (position, velocity, joint.load, joint.effort, joint.way, joint.sought)
        for name, value in zip(FIELDS, values, strict=True):
            cycles[name][:, row] = value
        cycles["torque"][:, row] = joint.torque
        facts = {"bus": "main", "servos": f"servo {row}", "top_effort": 1.0, "tick": TICK, **joint.planned}
        planned.append(PlannedJoint(names[row] if names else f"j{row}", **facts))
    references = [f"pid/{joint.name}/position" for joint in planned]
    movement = Movement(planned, int(cycles["read_ns"][0]), references)
    ways = np.array([joint.way for joint in joints]).T
    for begin in range(0, len(TIME), 150):  # slice by slice, two cycles of the one before with each
        known = min(begin, 2)
        part = slice(begin - known, begin + 150)
        movement.add_cycles(cycles[part], ways[part], known)
    return list(movement.findings())
