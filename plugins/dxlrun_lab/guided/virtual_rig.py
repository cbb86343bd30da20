"""Rig of a robot on virtual time, for `--virtual` and for tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from dxlrun import RemoteRobot
from dxlrun.tooling.plans import Plan
from dxlrun.tooling.runs import VirtualLink
from dxlrun_lab.guided.rig import Rig


def virtual_rig(
    plan: Plan, *, log: Path | None = None, each_cycle: Callable[[int], None] = lambda cycle: None
) -> Rig:
    """Return the rig of a robot on virtual time; see VirtualLink."""
    link = VirtualLink(plan, log=log, client="experiment", each_cycle=each_cycle)
    robot = RemoteRobot(plan.robot, link)
    return Rig(robot, plan, link.new, log=log, end=lambda: link.simulated.failures, now_s=lambda: link.now_s)
