"""Commands of devices stay inside the ranges of their items; an event says when one is held."""

import numpy as np
import pytest

from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.events import EventCode
from dxlrun.control.gate import Gate
from dxlrun.plan.loop_plan import LoopPlan, SchedulerPlan, SourcePlan

LIGHT = SourcePlan(
    "light",
    "device",
    ("voltage",),
    ("lamp", "level"),
    label="light (ID 102 on bus main)",
    ranges=((0.0, 1.0), (-2.0, 2.5)),
)


class Rig:
    def __init__(self):
        self.events = []
        plan = LoopPlan(10_000_000, SchedulerPlan("other", 1, False), (), (), (), None, sources=(LIGHT,))
        self.record = CycleRecord(plan.layout)
        self.gate = Gate(plan, self.record, self)

    def emit(self, code, severity, source, text, data=b""):
        assert code == EventCode.GATE
        self.events.append((source, text))

    def apply(self, *commands):
        self.record.device_command[:] = commands
        self.gate.apply(self.record.commands, self.record.goals, 10_000_000)
        return self.record.device_command.tolist()


def test_a_command_beyond_its_range_is_held_at_the_end_and_reported_once():
    rig = Rig()
    assert rig.apply(1.0, -2.0) == [1.0, -2.0]
    assert rig.events == []
    assert rig.apply(3.0, -7.0) == [1.0, -2.0]
    expected = [
        ("light", "light (ID 102 on bus main): lamp was commanded 3, held to 0..1"),
        ("light", "light (ID 102 on bus main): level was commanded -7, held to -2..2.5"),
    ]
    assert rig.events == expected
    rig.apply(4.0, 2.0)
    rig.gate.apply(rig.record.commands, rig.record.goals, 10_000_000)  # nothing was commanded anew
    rig.apply(5.0, 9.0)
    assert rig.events == [
        *expected,
        ("light", "light (ID 102 on bus main): level was commanded 9, held to -2..2.5"),
    ]


def test_what_is_not_commanded_stays_so():
    rig = Rig()
    assert rig.apply(np.nan, 1.0) == [pytest.approx(np.nan, nan_ok=True), 1.0]
    assert rig.events == []
