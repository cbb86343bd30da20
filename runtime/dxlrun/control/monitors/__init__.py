"""Monitors: what is watched in every cycle, one file each; what a run does then is in its `policies`.

A policy that reacts to states belongs here: a file with a class such as those of `MONITORS`, which acts by
`PolicyActions`. Neither the loop nor `check` changes for it.
"""

from __future__ import annotations

from dxlrun.channels.cycle import CycleRecord
from dxlrun.control.monitors.lost_servos import LostServos
from dxlrun.control.monitors.monitor import Monitor
from dxlrun.control.monitors.needed_sensors import NeededSensors
from dxlrun.control.monitors.policy_actions import PolicyActions
from dxlrun.plan.loop_plan import LoopPlan

MONITORS: tuple[type[Monitor], ...] = (LostServos, NeededSensors)
"""In the order in which a cycle asks them, and in which `check` shows their policies."""


def build_monitors(plan: LoopPlan, record: CycleRecord, actions: PolicyActions) -> tuple[Monitor, ...]:
    """Return the monitors that have something to watch in this robot."""
    built = (one.build(plan, record, actions) for one in MONITORS)
    return tuple(one for one in built if one is not None)
