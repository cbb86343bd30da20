from collections.abc import Callable, Sequence

import numpy as np
from dxlrun_backlash.joint_key import STAGE as BACKLASH

from dxlrun import Commands, States
from dxlrun.tooling.features import EventSink, Hardware, HardwareLayer, LayerStage, PreparedLayer
from dxlrun.tooling.plans import Plan


class BacklashLayer(HardwareLayer):
    def __init__(self, hardware: Hardware, plays: Sequence[float], goals: Commands, below: Commands) -> None:
        super().__init__(hardware)
        self._goals, self._below = goals, below
        self._half = np.array(plays) / 2
        self._side = np.zeros(len(plays))  # Direction of the last movement; 0: none since torque came on
        self._last = np.full(len(plays), np.nan)

    def start(self, engaging: Callable[[], None] = lambda: None) -> None:
        super().start(engaging)
        self._goals.values[:] = self._below.values

    def write_goals(self) -> None:
        moved = np.sign(np.nan_to_num(self._goals.position - self._last))
        self._side[moved != 0] = moved[moved != 0]
        self._last[:] = self._goals.position
        self._below.values[:] = self._goals.values
        self._below.position[:] += self._side * self._half
        super().write_goals()

    def follow_goals(self, rows: Sequence[int]) -> None:
        self._side[rows], self._last[rows] = 0.0, np.nan
        super().follow_goals(rows)


def prepare_backlash(plan: Plan, states: States, goals: Commands, events: EventSink) -> PreparedLayer | None:
    plays = [BACKLASH.value_of(joint) or 0.0 for joint in plan.loop.joints]
    if not any(plays):
        return None
    below = Commands.empty(len(plays))
    return PreparedLayer(states, below, lambda hardware: BacklashLayer(hardware, plays, goals, below))


STAGE = LayerStage(prepare_backlash)
