"""Monitor: what every monitor of the loop has."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol, Self

from dxlrun.channels.cycle import CycleRecord
from dxlrun.control.monitors.policy_actions import PolicyActions
from dxlrun.plan.loop_plan import LoopPlan


class Monitor(Protocol):
    """Watches one thing in every cycle, and acts when it is not as planned.

    It decides by the record and the plan alone, so a replay decides like the run. It allocates nothing that
    grows from cycle to cycle.
    """

    @classmethod
    def build(cls, plan: LoopPlan, record: CycleRecord, actions: PolicyActions) -> Self | None:
        """Return a monitor for this robot; None: it has nothing to watch, and costs nothing."""

    def check(self, time_ns: int) -> None:
        """Look at the states of this cycle, before commands and controllers; not while a run ends.

        Args:
            time_ns: The controllers' time.
        """


@dataclass(frozen=True)
class MonitorStage:
    """`STAGE` of `monitor.py`: asked when a loop is built."""

    FILE: ClassVar[str] = "monitor"

    monitor: type[Monitor]
