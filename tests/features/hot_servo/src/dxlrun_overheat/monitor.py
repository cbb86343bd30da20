"""Monitor of overheated servos."""

from __future__ import annotations

from typing import Self

from dxlrun.tooling.features import MonitorStage, PolicyActions
from dxlrun.tooling.plans import LoopPlan
from dxlrun.tooling.records import CycleRecord


class Overheat:
    def __init__(self, record: CycleRecord, actions: PolicyActions) -> None:
        self._states, self._actions = record.states, actions

    @classmethod
    def build(cls, plan: LoopPlan, record: CycleRecord, actions: PolicyActions) -> Self | None:
        return None if plan.policies.named("on_overheat").goes_on else cls(record, actions)

    def check(self, time_ns: int) -> None:
        if (self._states.temperature > 72.0).any():
            self._actions.end_run("on_overheat", "a servo is above 72 degC")


STAGE = MonitorStage(Overheat)
