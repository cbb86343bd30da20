"""Monitors: what is watched in every cycle; what a run does then is in its `policies`.

A policy that reacts to states is a class such as `LostServos`, which acts by `PolicyActions`; a feature has
its own in `monitor.py`. Neither the loop nor `check` changes for it.
"""

from __future__ import annotations

from collections.abc import Iterable

from dxlrun.channels.cycle import CycleRecord
from dxlrun.control.monitors.lost_servos import LostServos
from dxlrun.control.monitors.monitor import Monitor, MonitorStage
from dxlrun.control.monitors.policy_actions import PolicyActions
from dxlrun.features import stages
from dxlrun.features.feature import Feature
from dxlrun.plan.loop_plan import LoopPlan


def list_monitors(features: Iterable[Feature]) -> tuple[type[Monitor], ...]:
    """Return all monitors, in the order of a cycle and of the policies that `check` shows."""
    return (LostServos, *(stage.monitor for _, stage in stages(MonitorStage, features)))


def build_monitors(plan: LoopPlan, record: CycleRecord, actions: PolicyActions) -> tuple[Monitor, ...]:
    """Return the monitors that have something to watch in this robot."""
    built = (one.build(plan, record, actions) for one in list_monitors(plan.features))
    return tuple(one for one in built if one is not None)
