"""Policy `on_hot_servo`: acts once when a servo becomes hot, and holds controllers until it is cool."""

from typing import Literal, Self

import msgspec
import numpy as np

from dxlrun import Temperature
from dxlrun.tooling.features import (
    Compilation,
    CompileStage,
    Contribution,
    MonitorStage,
    PolicyActions,
    PolicyKey,
    event_text,
)
from dxlrun.tooling.files import Form, key
from dxlrun.tooling.plans import LoopPlan
from dxlrun.tooling.records import CycleRecord, EventCode, Severity

NAME = "on_hot_servo"
EXAMPLE = "{above: 70 degC, do: limp}"
MOST = 100.0  # degC


class HotServo(Form):
    above: Temperature = key("Temperature from which a servo is hot.", "70 degC")
    do: Literal["stop", "hold", "limp", "continue"] = key(
        "Its action; stop: the run ends by on_fault.", "limp"
    )


GROUP = PolicyKey[HotServo | None](
    NAME, HotServo | None, key("As the policy of that name, for this group.", EXAMPLE, None)
)
KEY = PolicyKey[HotServo | None](
    NAME, HotServo | None, key("When a servo is hot.", EXAMPLE, None), group=GROUP
)


def compile_hot_servo(compilation: Compilation) -> Contribution:
    file, plan = compilation.file, {}
    policies = file.robot.policies
    for joint in compilation.joints:
        hot = policies.of_joint(NAME, joint)
        if isinstance(hot, HotServo):
            plan[joint] = hot.above, hot.do
            if hot.above > MOST:
                place = file.at("policies", NAME, "above")
                file.error(place, f"no servo works at {hot.above:g} degC", f"write {MOST:g} degC at most")
    if not plan:
        return Contribution()
    does = ", ".join(f"{joint} above {above:g} degC: {do}" for joint, (above, do) in plan.items())
    return Contribution(policies={NAME: does}, plan=msgspec.json.encode(plan))


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

    def check_cycle(self, time_ns: int) -> None:
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


STAGES = (KEY, CompileStage(compile_hot_servo), MonitorStage(HotServos))
