"""Monitors: checks of every cycle that act according to the run's `policies`.

A policy that reacts to states is a feature with a class such as `LostServos` in its `monitor.py`, which acts
through `PolicyActions`. A new one changes neither the loop nor `check`.
"""

from __future__ import annotations

from dxlrun.channels.cycle import CycleRecord
from dxlrun.control.monitors.monitor_stage import Monitor, MonitorStage
from dxlrun.control.monitors.policy_actions import PolicyActions
from dxlrun.features import stages
from dxlrun.plan.loop_plan import LoopPlan


def build_monitors(plan: LoopPlan, record: CycleRecord, actions: PolicyActions) -> tuple[Monitor, ...]:
    """Return the monitors that apply to this robot, in the order in which each cycle calls them."""
    built = (stage.monitor.build(plan, record, actions) for _, stage in stages(MonitorStage, plan.features))
    return tuple(one for one in built if one is not None)
