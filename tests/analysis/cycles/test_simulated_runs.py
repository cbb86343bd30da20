"""Causes of runs on simulated servos with faults: by packets alone, and never a servo that was well."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.kit.totals import totals_of

from dxlrun.run.virtual_run import VirtualRobot
from dxlrun.simulation.faults.fault import parse_fault
from dxlrun.simulation.faults.script import FaultScript
from dxlrun.testing import simulated_robot
from dxlrun_analysis.causes.causes import Causes
from dxlrun_analysis.verdict import judge
from dxlrun_controllers.joint_state_broadcaster import JointStateBroadcaster

ELBOW = "servo 5 (left_elbow_joint)"


def robot_of(log: Path) -> VirtualRobot:
    """Return a torso at 100 Hz; its reads take 5 ms."""
    return simulated_robot("robots/bioloid_torso.yaml", arguments={"rate": "100"}, duration_s=1.2, log=log)


def causes_of(log: Path, fault: str = "") -> Causes:
    robot = robot_of(log)
    if fault:
        FaultScript([parse_fault(fault)]).attach(robot.buses)
    robot.run()
    found = totals_of(log).causes
    assert sum(one.total_ns for one in found.causes) == found.excess_ns
    for worst in found.worst:
        assert sum(one.us for one in worst.causes) == pytest.approx(worst.excess_us)
    return found


@pytest.mark.parametrize(
    ("fault", "kind", "least_ms"),
    [
        ("slow servo=5 by=8ms at=500ms for=400ms", "late reply", 8),
        ("silence servo=5 at=500ms for=400ms", "missing reply", 10),
        ("lose servo=5 at=500ms", "missing reply", 10),
    ],
)
def test_the_fault_has_the_time_and_a_missing_reply_its_servo(
    tmp_path: Path, fault: str, kind: str, least_ms: float
) -> None:
    found = causes_of(tmp_path / "run.mcap", fault)
    subject = "bus main" if kind == "late reply" else ELBOW
    assert {(one.kind, one.subject) for one in found.causes} == {(kind, subject)}
    assert found.causes[0].worst_ns >= least_ms * 1e6
    worst = found.worst[0]
    elbow = [one for one in worst.packets if one.joint == "left_elbow_joint"]
    assert elbow[0].kind == "instruction"
    if kind == "late reply":
        assert elbow[1].planned_us is not None
        assert elbow[1].end_us - elbow[1].planned_us == pytest.approx(least_ms * 1e3, abs=100)
    else:
        assert [one.kind for one in elbow] == ["instruction"]


def test_a_run_without_fault_has_no_causes_and_a_latency_timer_accuses_no_servo(tmp_path: Path) -> None:
    found = causes_of(tmp_path / "well.mcap")
    assert (found.causes, found.long, found.late, found.worst) == ((), 0, 0, ())
    found = causes_of(tmp_path / "run.mcap", "timer by=5ms at=500ms for=500ms")
    assert found.long > 3
    assert (found.causes[0].kind, found.causes[0].subject) == ("late reply", "bus main")
    assert not any("servo" in one.subject for one in found.causes)


def test_a_slow_controller_is_named_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = tmp_path / "run.mcap"
    update = JointStateBroadcaster.update

    def slow(self: JointStateBroadcaster, time_ns: int, period_ns: int) -> None:
        update(self, time_ns, period_ns)
        robot.clock.wait_until(robot.clock.now_ns() + 12_000_000)

    monkeypatch.setattr(JointStateBroadcaster, "update", slow)
    robot = robot_of(log)
    robot.run()
    totals = totals_of(log)
    assert (totals.causes.causes[0].kind, totals.causes.causes[0].subject) == (
        "controller",
        "joint_state_broadcaster",
    )
    first = judge(totals).findings[1]
    assert (first.code, first.subject) == ("slow_controller", "joint_state_broadcaster")
    assert not any("servo" in one.subject for one in totals.causes.causes)
