"""Policy `on_overheat`: steps that end the run when a servo is too hot."""

from typing import Self

from dxlrun.tooling.features import MonitorStage, PolicyActions, PolicyKey, WrittenPolicy
from dxlrun.tooling.files import key
from dxlrun.tooling.plans import LoopPlan
from dxlrun.tooling.records import CycleRecord

NAME = "on_overheat"
HELP = "When a servo is above 72 degC; hold: the run continues."


class Overheat:
    def __init__(self, record: CycleRecord, actions: PolicyActions) -> None:
        self._states, self._actions = record.states, actions

    @classmethod
    def build(cls, plan: LoopPlan, record: CycleRecord, actions: PolicyActions) -> Self | None:
        return None if plan.policies.named(NAME).goes_on else cls(record, actions)

    def check_cycle(self, time_ns: int) -> None:
        if (self._states.temperature > 72.0).any():
            self._actions.end_run(NAME, "a servo is above 72 degC")


STAGES = (
    PolicyKey(NAME, WrittenPolicy, key(HELP, "[{pose: rest, speed: 60 deg/s}]", "hold"), does="continue"),
    MonitorStage(Overheat),
)
