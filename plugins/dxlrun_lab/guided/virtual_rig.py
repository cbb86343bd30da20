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
    """Return a rig that runs a robot's plan on virtual time, with simulated servos.

    The cycles come from the loop itself; `log` is also written if given. `each_cycle` is called with the
    number of each cycle (see VirtualLink).
    """
    link = VirtualLink(plan, log=log, client="experiment", each_cycle=each_cycle)
    robot = RemoteRobot(plan.robot, link)
    return Rig(robot, plan, link.new, log=log, end=lambda: link.simulated.failures, now_s=lambda: link.now_s)
