"""Monitor: interface of the loop's monitors."""

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
        """Return a monitor for this robot, or None if it does not apply."""

    def check(self, time_ns: int) -> None:
        """Check the states of this cycle. Called before commands and controllers, except while a run ends.

        Args:
            time_ns: The controllers' time.
        """


class MonitorStage(msgspec.Struct, frozen=True):
    """`STAGE` of `monitor.py`, used when a loop is built."""

    FILE: ClassVar[str] = "monitor"

    monitor: type[Monitor]
