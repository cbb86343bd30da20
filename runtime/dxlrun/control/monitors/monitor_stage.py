"""Monitor: interface of the checks that features run in every cycle of the loop."""

from __future__ import annotations

from typing import ClassVar, Protocol, Self

import msgspec

from dxlrun.channels.cycle import CycleRecord
from dxlrun.control.monitors.policy_actions import PolicyActions
from dxlrun.plan.loop_plan import LoopPlan


class Monitor(Protocol):
    """Check of one condition in every cycle.

    Its decisions depend on the record and the plan only, so a replay makes the same ones. Its memory must not
    grow from cycle to cycle.
    """

    @classmethod
    def build(cls, plan: LoopPlan, record: CycleRecord, actions: PolicyActions) -> Self | None:
        """Return a monitor for this robot, or None if the feature has nothing to check."""

    def check_cycle(self, time_ns: int) -> None:
        """Check the states of this cycle, and act on them. Called before commands and controllers.

        Args:
            time_ns: The controllers' time.
        """


class MonitorStage(msgspec.Struct, frozen=True):
    """Monitor of a feature: the object `STAGE` of its `monitor.py`, used when a loop is built."""

    FILE: ClassVar[str] = "monitor"

    monitor: type[Monitor]
