"""A battery that runs down under simulated servos: a sag does nothing, low warns, empty switches or ends."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dxlrun.channels.event_records import EventCode
from dxlrun.channels.ring import RecordKind
from dxlrun.log.log_reader import Log, read_log
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun.testing import plan_of
from dxlrun_analysis.replay import replay_log

ROBOT = """\
name: pair
buses:
  main:
    {{port: sim, protocol: 1.0, baud_rate: 1_000_000, adapter: {{latency: 1 ms}}, return_delay_time: 100 us}}
loop: {{rate: 50}}
joints:
  pan: {{bus: main, id: 3, model: AX-12A, reference: 150 deg, direction: 1}}
  tilt: {{bus: main, id: 7, model: AX-12A, reference: 150 deg, direction: 1}}
controllers:
  head: {{type: joint_group_position_controller, joints: [pan, tilt]}}
  sit:
    type: keyframe_player
    active: false
    joints: [pan, tilt]
    start: sit
    motions: {{sit: {{steps: [{{time: 200 ms, pose: {{pan: 10 deg, tilt: -10 deg}}}}]}}}}
  battery:
    {{type: battery_state_broadcaster, voltages: [pan/voltage, tilt/voltage], cells: 3, warn: 3.6 V,
      stop: 3.4 V, filter: 300 ms, activate: {activate}}}
policies: {{on_fault: limp}}
"""
SAG, LOW, EMPTY = 9.6, 10.5, 9.8


@pytest.fixture
def drained(tmp_path: Path) -> Callable[..., tuple[Any, Log]]:
    """Run the robot while its supply has these voltages from these cycles on."""

    def run(activate: str, voltages: dict[int, float]) -> tuple[Any, Log]:
        (tmp_path / "pair.yaml").write_text(ROBOT.format(activate=activate))
        count = 0

        def watch(kind: RecordKind, payload: object) -> None:
            nonlocal count
            if kind == RecordKind.CYCLE:
                for servo in (3, 7):
                    found = robot.buses[0].servo(servo)
                    found.voltage = voltages.get(count, found.voltage)
                count += 1

        plan = plan_of(tmp_path / "pair.yaml", duration_s=4.0)
        robot = VirtualRobot(plan, log=tmp_path / "run.mcap", watch=watch)
        result = robot.run()
        assert replay_log(tmp_path / "run.mcap").same
        return result, read_log(tmp_path / "run.mcap")

    return run


def texts(log: Log, code: EventCode) -> list[str]:
    return [event.text for event in log.events if event.code == code and event.source == "battery"]


def test_an_empty_battery_lets_a_safe_pose_take_over(drained):
    result, log = drained("[sit]", {30: SAG, 34: 12.0, 60: LOW, 110: EMPTY})
    assert result.reason == "ended"
    (warning,) = texts(log, EventCode.CONTROLLER_SAYS)
    assert warning.startswith("the battery is low: 3.6")
    (takeover,) = texts(log, EventCode.TAKEOVER)
    assert takeover.startswith("sit takes over from head: the battery has 3.40 V a cell")
    (at,) = (event.t_ns for event in log.events if event.code == EventCode.TAKEOVER)
    assert 110 * 0.02 < at * 1e-9 < 110 * 0.02 + 1.0
    assert log.cycles["goal_position"][-1] == pytest.approx(np.radians([10, -10]), abs=0.01)
    assert len(log.topics["/battery/battery_state"].column("voltage")) == 4


def test_without_one_the_run_ends_by_the_policy_for_faults(drained):
    result, log = drained("[]", {30: EMPTY})
    assert result.reason == "fault"
    assert result.detail.startswith("controller battery ended the run: the battery has 3.40 V a cell (10.")
    assert result.last == "limp"
    assert 30 < len(log.cycles) < 100
