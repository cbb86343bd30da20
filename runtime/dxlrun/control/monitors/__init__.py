"""Monitors: what is watched in every cycle; what a run does then is in its `policies`.

A policy that reacts to states is a feature whose `monitor.py` has a class such as `LostServos`, which acts by
`PolicyActions`. Neither the loop nor `check` changes for it.
"""

from __future__ import annotations

from dxlrun.channels.cycle import CycleRecord
from dxlrun.control.monitors.monitor import Monitor, MonitorStage
from dxlrun.control.monitors.policy_actions import PolicyActions
from dxlrun.features import stages
from dxlrun.plan.loop_plan import LoopPlan


def build_monitors(plan: LoopPlan, record: CycleRecord, actions: PolicyActions) -> tuple[Monitor, ...]:
    """Return the monitors that have something to watch in this robot, in the order of a cycle."""
    built = (stage.monitor.build(plan, record, actions) for _, stage in stages(MonitorStage, plan.features))
    return tuple(one for one in built if one is not None)
