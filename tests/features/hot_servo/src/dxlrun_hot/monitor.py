"""Monitor of hot servos: acts once when one becomes hot, and holds controllers until it is cool."""

from __future__ import annotations

from typing import Self

import msgspec
import numpy as np

from dxlrun.tooling.features import MonitorStage, PolicyActions, event_text
from dxlrun.tooling.plans import LoopPlan
from dxlrun.tooling.records import CycleRecord, EventCode, Severity

NAME = "on_hot_servo"


@event_text(EventCode.POLICY, Severity.WARNING)
def servo_is_hot(policy: str) -> str:
    return f"is hot; on_hot_servo: {policy}"


class HotServos:
    def __init__(self, plan: LoopPlan, record: CycleRecord, actions: PolicyActions) -> None:
        own = msgspec.json.decode(plan.feature_plans[NAME])
        self._joints = [joint.name for joint in plan.joints]
        self._above = np.array([own.get(name, (np.inf, ""))[0] for name in self._joints])
        self._do = [own.get(name, (np.inf, ""))[1] for name in self._joints]
        self._states, self._actions = record.states, actions
        self._hot: frozenset[int] = frozenset()

    @classmethod
    def build(cls, plan: LoopPlan, record: CycleRecord, actions: PolicyActions) -> Self | None:
        return cls(plan, record, actions) if NAME in plan.feature_plans else None

    def check(self, time_ns: int) -> None:
        hot = frozenset(np.flatnonzero(self._states.temperature > self._above).tolist())
        if hot == self._hot:
            return
        for row in sorted(hot - self._hot):
            self._actions.report(servo_is_hot(self._do[row]), source=self._joints[row])
            if self._do[row] == "stop":
                self._actions.end_run("on_fault", f"{self._joints[row]} is hot")
            if self._do[row] == "limp":
                self._actions.make_limp([row])
        held = [row for row in hot if self._do[row] == "hold"]
        self._actions.hold_controllers(self, held, "all its joints are cool")
        self._hot = hot


STAGE = MonitorStage(HotServos)
