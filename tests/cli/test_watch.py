"""`dxlrun watch`: what it shows of a robot, on every size of terminal, and how it ends."""

from __future__ import annotations

import io
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NoReturn

import numpy as np
import pytest
from msgspec.structs import replace
from rich.console import Console
from tests.kit.answers import result_of

from dxlrun import DxlrunError
from dxlrun.channels.cycle import CycleLayout, CycleRecord, Torque
from dxlrun.cli.steering import watch
from dxlrun.cli.steering.steer import RobotChoice
from dxlrun.output.text_table import Sentence
from dxlrun.remote.live.states import RobotStates
from dxlrun.remote.named.named_joints import states_of
from dxlwire.joint_unit import ROTARY
from dxlwire.modes import Mode

NAMES = ("arm_pid", "arm", "spare")
UNITS = {"foot/force.x": "N", "imu/voltage": "V"}


class Robot:
    """A robot with so many joints, which ends after some looks."""

    name = "humanoid"

    def __init__(self, joints: int = 20, looks: int = 1000, sources: bool = False) -> None:
        self.sources, self.looks, self.asked = sources, looks, 0
        self.names = [f"left_shoulder_joint_{number}" for number in range(joints)]

    def __enter__(self) -> Robot:
        return self

    def __exit__(self, *_: object) -> None: ...

    def info(self) -> dict[str, Any]:
        one = {"held": False, "rate": 50.0, "joints": self.names, "command": ["position"]}
        controllers = [
            {"name": name, "active": name != "spare", "into": ["arm_pid"] * (name == "arm"), **one}
            for name in NAMES
        ]
        known = {"rate": 50.0, "paused": False, "cycles": 7, "skipped": 2, "joints": self.names}
        return {**known, "controllers": controllers}

    def states(self) -> RobotStates:
        self.asked += 1
        if self.asked > self.looks:
            raise DxlrunError(f"{self.name} no longer answers: gone")
        rows = len(self.names)
        sources = {"foot": ("force.x", "force.y"), "imu": ("voltage",)} if self.sources else {}
        layout = CycleLayout(self.names, NAMES, (), sources)
        record = CycleRecord(layout)
        states, goals = record.states, record.goals
        woken_ns = (100 + self.asked) * 1_000_000_000
        record.wake(50 * self.asked, woken_ns - 100_000 * self.asked, woken_ns, 0)
        states.position[:], states.velocity[:], states.effort[:] = 0.5, -1e-9, 0.123
        states.valid[:], states.age_ns[:], goals.position[:] = True, 0, 0.6
        states.temperature[:], states.voltage[:] = 41.0, 11.8
        states.mode[:], states.torque[:] = Mode.POSITION, Torque.ON
        states.torque[1:4] = Torque.RELEASED, Torque.OFF, Torque.LOST
        states.hardware_error[2], states.temperature[3], states.position[3] = 0x20, np.nan, np.nan
        states.valid[3:5] = False
        goals.position[4], goals.velocity[4] = np.nan, 1.0
        if self.sources:
            record.sources.values[:] = 12.5, np.nan, 11.9
            record.sources.valid[:], record.sources.age_ns[:] = (False, True), (1_250_000_000, 2_000_000)
        record.controller_ns[1] = 25_000
        joints = [SimpleNamespace(unit=ROTARY)] * rows
        loop = SimpleNamespace(joints=joints, source_units=UNITS, command_units={})
        plan: Any = SimpleNamespace(loop=loop, servos_by_joint={})
        found = states_of(plan, record, {name: place for place, name in enumerate(layout.controllers)})
        return replace(found, effort_units=("A", *[""] * (rows - 1)))

    def events(self, after: int) -> dict[str, Any]:
        one = {"name": "gate", "source": "arm", "text": "something\nhappened " + "x" * 200}
        event = {"number": after + 1, "time": 100.0, "severity": 40, "origin": "", **one}
        return {"events": [event], "last": after + 1}


Shown = Callable[..., tuple[int, str]]


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Shown:
    """Run `watch` on a robot; return its exit code and what it printed."""

    def run(
        robot: Robot, *, runs: bool = False, as_json: bool = False, once: bool = False
    ) -> tuple[int, str]:
        monkeypatch.setattr(watch, "connect_robot", lambda *_: robot)
        monkeypatch.setattr(robot, "link", SimpleNamespace(alive=runs), raising=False)
        monkeypatch.setattr(watch, "REFRESH_S", 0.0)
        code = watch.watch_robot(once=once, chosen=RobotChoice(as_json=as_json))
        return code, capsys.readouterr().out

    return run


def frame(width: int, height: int, joints: int = 20, looks: int = 3, sources: bool = False) -> list[str]:
    """Return the lines of a view."""
    watched = watch.WatchedRobot(Robot(joints, sources=sources))  # type: ignore[arg-type]  # a stand-in
    for _ in range(looks):
        watched.poll_robot()
    file = io.StringIO()
    console = Console(file=file, width=width, height=height, force_terminal=False)
    console.print(watch.view(watched, width, height))
    return file.getvalue().splitlines()


def test_devices_and_sensors_are_shown_with_their_age(shown: Shown) -> None:
    code, printed = shown(Robot(sources=True), once=True)
    assert code == 0
    lines = [" ".join(line.split()) for line in printed.splitlines()]
    assert "foot 1250 ms, not valid force.x 12.5 N, force.y -" in lines
    assert "imu 2 ms voltage 11.9 V" in lines
    assert len(frame(80, 24, sources=True)) <= 24
    assert any("voltage 11.9" in line for line in frame(80, 40, sources=True))


def test_twenty_joints_fit_into_a_small_terminal() -> None:
    lines = frame(80, 24)
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    assert lines[0].startswith("humanoid: 50 Hz (50.0), cycle 150, late 0.30 ms (max 0.30), 2 skipped")
    rows = [line for line in lines if line.startswith("left_shoulder")]
    assert len(rows) == 20
    assert [row.split()[-1] for row in rows[:2]] == ["on", "limp"]
    assert rows[2].endswith(("limp error 0x20", "limp error 0…", "limp error…", "limp er…"))
    assert "active: arm_pid, arm" in lines[22]
    assert "s ago, arm: something happened" in lines[23]


@pytest.mark.parametrize("width", [40, 80, 200])
@pytest.mark.parametrize("height", [10, 24, 60])
def test_no_size_breaks_it_and_a_large_one_has_controllers_and_events(width: int, height: int) -> None:
    lines = frame(width, height, joints=6)
    assert max(map(len, lines)) <= width
    assert len(lines) <= max(height, 8)
    if (width, height) == (200, 60):
        text = "\n".join(lines)
        assert ("arm_pid" in text, "25 us" in text) == (True, True)
        assert text.count("something happened") == 3


def test_measured_rate_is_that_of_the_last_second(monkeypatch: pytest.MonkeyPatch) -> None:
    robot, cycles = Robot(), iter((100, 150, 160))
    states = robot.states
    monkeypatch.setattr(robot, "states", lambda: replace(states(), cycle=next(cycles)))
    watched = watch.WatchedRobot(robot)  # type: ignore[arg-type]  # a stand-in
    rates = []
    for _ in range(3):
        watched.poll_robot()
        rates.append(watched.rate)
    assert rates == [None, pytest.approx(50.0), pytest.approx(10.0)]


def test_pipe_gets_one_snapshot(shown: Shown) -> None:
    robot = Robot(6)
    code, said = shown(robot)
    assert (code, robot.asked) == (0, 1)
    assert "humanoid: 50 Hz, cycle 50" in said
    texts = (
        "34.4",
        "28.6",
        "0.12 A",
        "12 %",
        "57.3/s",
        "limp error 0x20",
        "lost",
        "on silent",
        "arm_pid",
        "spare",
    )
    assert [text for text in texts if text not in said] == []
    assert "-0.0" not in said
    assert "\x1b" not in said


def test_json_is_one_object_a_line_until_the_run_ends(shown: Shown) -> None:
    code, said = shown(Robot(6, looks=4), as_json=True)
    lines = [result_of(line) for line in said.splitlines()]
    assert code == 0
    assert [(line["cycle"], len(line["events"])) for line in lines] == [(50, 1), (100, 1), (150, 1), (200, 1)]
    assert lines[2]["measured_rate"] == pytest.approx(50.0)
    assert shown(Robot(6), as_json=True, once=True)[1].count("\n") == 1


def test_ctrl_c_ends_it_and_a_robot_that_does_not_answer_is_an_error(
    shown: Shown, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(DxlrunError, match="no longer answers"):
        shown(Robot(6, looks=2), runs=True, as_json=True)

    def interrupt(_: float) -> NoReturn:
        raise KeyboardInterrupt

    monkeypatch.setattr(watch.time, "sleep", interrupt)
    assert shown(Robot(6), as_json=True)[0] == 0


def test_newest_event_is_the_last() -> None:
    watched = watch.WatchedRobot(Robot())  # type: ignore[arg-type]  # a stand-in
    watched.poll_robot()
    event = {"severity": 20, "source": "loop", "name": "steered"}
    origins = {1.0: "anna", 2.0: "anna", 3.0: "loop", 4.0: "loop"}  # the last two are of each start
    watched.events = [{**event, "time": at, "text": str(at), "origin": who} for at, who in origins.items()]
    assert watch.event_lines(watched, 0) == []
    assert watch.event_lines(watched, 1) == [Sentence(" 99.0 s ago, loop: 2.0", "plain")]
