"""Parts of features on a bus: the calls that a package gets in a run, and at its end."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from tests.kit.plans import make_plan
from tests.kit.rigs import Rig, start_rig

from dxlrun.dynamixel.bus_part import SafeEnd
from dxlrun.features.feature import Feature

NOTED = Feature("noted", "noted_feature")
RUNTIME = """
from dxlrun.tooling.features import BusStage
calls = []
class Part:
    def judge_replies(self, now_ns): pass
    def recover_line(self): calls.append("line")
    def recover_servo(self, servo): calls.append(servo)
    def schedule_idle_work(self, time_ns): calls.append(f"{time_ns} ns")
STAGE = BusStage(lambda context: Part())
"""
SAFE = """
from dxlrun.tooling.features import SafeStage
STAGE = SafeStage(lambda lines, plan: (f"{len(lines.plans)} lines, {plan.decode()}",))
"""


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Calls that a feature `noted` got; rigs have it as their only one."""
    package = tmp_path / "noted_feature"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "runtime.py").write_text(RUNTIME)
    (package / "safe.py").write_text(SAFE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr("tests.kit.rigs.FEATURES", (NOTED,))
    made: list[Any] = import_module("noted_feature.runtime").calls
    made.clear()
    return made


def recovered(calls: list[Any]) -> list[Any]:
    return [call for call in calls if call == "line" or isinstance(call, int)]


def started() -> Rig:
    return start_rig(make_plan((1, 2), model="XL430-W250", protocol=2.0))


def test_part_gets_time_of_the_cycle_in_idle_time(calls):
    rig = started()
    for time_ns in (0, 20):
        rig.hardware.read_states()
        rig.hardware.write_goals()
        rig.hardware.idle(rig.clock.now_ns() + 10_000_000, time_ns)
    assert calls == ["0 ns", "20 ns"]


def test_part_recovers_servo_that_rebooted(calls):
    rig = started()
    rig.cycles(10)
    assert recovered(calls) == []
    rig.buses[0].servo(2).cut_power(rig.clock.now_ns() + 300_000_000)
    rig.cycles(200)
    assert rig.states.valid.all()
    assert recovered(calls) == [1]


def test_part_recovers_line_then_each_of_its_servos(calls):
    rig = started()
    rig.buses[0].unplug()
    rig.cycles(3)
    rig.buses[0].plug_in()
    rig.cycles(100)
    assert rig.states.valid.all()
    assert recovered(calls)[0] == "line"
    assert sorted(recovered(calls)[1:]) == [0, 1]


def test_safe_stage_gets_plan_of_its_feature(calls):
    end = SafeEnd.import_stages((NOTED,), {"noted": b"left and right", "devices": b"others"})
    assert end.make_safe(started().hardware._lines) == ("1 lines, left and right",)
    assert SafeEnd.import_stages((NOTED,), {}).make_safe(started().hardware._lines) == ("1 lines, ",)


@pytest.mark.parametrize(
    ("name", "call", "raised"),
    [("failing", "plan[0]", "IndexError: index out of range"), ("exiting", "exit(3)", "SystemExit: 3")],
)
def test_feature_that_fails_at_the_end_leaves_the_others_safe(name, call, raised, tmp_path, calls):
    failing = tmp_path / f"{name}_feature"
    failing.mkdir()
    (failing / "__init__.py").touch()
    (failing / "safe.py").write_text(
        f"from dxlrun.tooling.features import SafeStage\nSTAGE = SafeStage(lambda lines, plan: {call})\n"
    )
    end = SafeEnd.import_stages((Feature(name, f"{name}_feature", f"{name} 1.0"), NOTED), {})
    assert end.make_safe(started().hardware._lines) == (
        f"section {name} failed to set its safe state ({raised}); report it to the author of {name} 1.0",
        "1 lines, ",
    )
