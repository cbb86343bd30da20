"""A replay of a steered controller graph has no difference: chains, goals, torque, reboots, parameters.

CI tries 5 random runs; DXLRUN_STEERED_GRAPHS=500 tries more.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.stories import Asked, ask, differing, rate, replayed, send, silence, switch, tell, torque

from dxlrun.channels.commands import Command
from dxlrun.channels.events import GoalReport
from dxlrun.control.controllers.goals import Goals
from dxlrun.control.controllers.plugins import load_plugins
from dxlrun.log.reader import Log
from dxlrun.testing import VirtualRobot
from dxlrun_analysis.client_commands import client_commands

MS = 1_000_000
CYCLES = 70
ROBOT = """\
name: graph
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, return_delay_time: 20 us}
loop: {rate: 50}
joints:
  shoulder:
    {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1, limits: {velocity: 3 rad/s}}
  elbow: {bus: main, id: 2, model: XM430-W350, reference: 180 deg, direction: -1}
  wrist: {bus: main, id: 3, model: XM430-W350, reference: 180 deg, direction: 1}
  mirror: {bus: main, id: 4, model: XM430-W350, reference: 180 deg, direction: 1}
controllers:
  states: {type: joint_state_broadcaster}
  arm_pid:
    {type: pid_controller, joints: [shoulder, elbow], gains: {p: 3.0, i: 1.0, d: 0.1}, fallback: standby}
  arm: {type: joint_trajectory_controller, joints: [shoulder, elbow], rate: 25, into: arm_pid}
  standby: {type: joint_group_position_controller, joints: [shoulder, elbow], active: false}
  turn: {type: pid_controller, joints: [wrist], command_interface: velocity, gains: {p: 4.0}}
  hand: {type: joint_group_position_controller, joints: [wrist], into: [turn]}
  follow: {type: leader_follower, pairs: [{joint: mirror, leader: elbow, scale: 0.5}], speed: 1 rad/s}
"""
JOINTS = ("shoulder", "elbow", "wrist", "mirror")
CONTROLLERS = ("arm_pid", "arm", "standby", "turn", "hand", "follow")
_OFFERS = load_plugins().controllers


def trajectory(shoulder: float, elbow: float, seconds: float) -> Command:
    """Return a goal for `arm`, prepared as the gateway does."""
    offered = _OFFERS["joint_trajectory_controller"].controller
    parameters = offered.Parameters.model_validate({"joints": ("shoulder", "elbow")})
    command = offered.Commands["trajectory"].model_validate(
        {"points": [{"time": seconds, "positions": [shoulder, elbow]}]}
    )
    return send("arm", "trajectory", *offered.prepare("trajectory", command, parameters))


def play(angle: float, seconds: float) -> Command:
    """Return a motion: three positions for `hand` by time, and a trajectory for `arm`, in one cycle."""
    arm, steps = trajectory(angle, -angle, seconds).data, [0.0, angle / 2, angle]
    parts = [
        {"controller": "hand", "kind": "positions", "at_ns": [0, 60 * MS, round(seconds * 1e9)]}
        | {"sizes": [1, 1, 1], "end_ns": round(seconds * 1e9)},
        {"controller": "arm", "kind": "trajectory", "at_ns": [0], "sizes": [len(arm) // 8], "end_ns": 0},
    ]
    head = msgspec.json.encode({"parts": parts})
    data = head + b"\n" + np.array(steps, dtype="<f8").tobytes() + arm
    return Command(0, "", "play", data, "anna")


ANGLES = st.floats(-1, 1)
NAMES = st.lists(st.sampled_from(JOINTS), min_size=1, max_size=2, unique=True)
COMMANDS = st.one_of(
    st.builds(trajectory, ANGLES, ANGLES, st.sampled_from([0.1, 0.3, 0.8])),
    st.builds(play, ANGLES, st.sampled_from([0.1, 0.3, 0.8])),
    st.builds(lambda goal: ask("cancel", {"goal": goal}), st.integers(0, 4)),
    st.builds(lambda name: ask("cancel", {"controller": name}), st.sampled_from(["arm", "arm", "hand"])),
    st.builds(switch, *[st.lists(st.sampled_from(CONTROLLERS), max_size=3)] * 2),
    st.sampled_from([
        switch(["standby"], ["arm", "arm_pid"]),
        switch(["arm"], ["standby"]),
        switch([], ["hand", "turn"]),
        switch(["hand"]),
    ]),
    st.builds(
        lambda a, lease: send("hand", "positions", a, lease_ns=lease), ANGLES, st.sampled_from([0, 60 * MS])
    ),
    st.builds(lambda a: send("turn", "positions", a), ANGLES),
    st.builds(
        lambda p, i: ask("parameters", {"controller": "arm_pid", "values": {"gains.p": p, "gains.i": i}}),
        st.floats(0, 6),
        st.floats(0, 3),
    ),
    st.builds(
        lambda speed: ask("parameters", {"controller": "follow", "values": {"speed": speed}}),
        st.floats(0.1, 3),
    ),
    st.builds(torque, NAMES, on=st.booleans(), release=st.booleans()),
    st.builds(
        lambda joints, release: ask("reboot", {"joints": joints, "release": release}), NAMES, st.booleans()
    ),
    st.just(ask("halt")),
    st.sampled_from([25.0, 50.0, 100.0]).map(rate),
    st.sampled_from(["pause", "resume", "resume"]).map(ask),
)  # fmt: skip


@pytest.fixture(scope="module")
def steer(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Run the robot while clients request these commands in these cycles; return the log."""
    directory = tmp_path_factory.mktemp("graphs")
    (directory / "graph.yaml").write_text(ROBOT)

    def run(asked: Asked, silent: Sequence[tuple[int, int, int]] = ()) -> Path:
        def before(robot: VirtualRobot) -> None:
            for servo, begin_ms, length_ms in silent:
                silence(robot, [servo], begin_ms, begin_ms + length_ms)

        asked = {**asked, CYCLES + 10: [ask("stop")]}
        log = directory / "run.mcap"
        return tell(directory / "graph.yaml", asked, log, seconds=CYCLES / 50, before=before)

    return run


def assert_chains(log: Log) -> None:
    """Assert that no controller was active without the one below it, and no joint had two commanders."""
    names = ("states", *CONTROLLERS)
    for mask in {int(mask) for mask in log.cycles["active"]}:
        active = {name for bit, name in enumerate(names) if mask >> bit & 1}
        assert {"arm", "arm_pid"} & active != {"arm"}, active
        assert {"hand", "turn"} & active != {"hand"}, active
        assert not {"arm_pid", "standby"} <= active, active


STORY: dict[int, list[Command]] = {
    3: [trajectory(0.5, -0.3, 0.3)],
    6: [ask("parameters", {"controller": "arm_pid", "values": {"gains.p": 5.0}})],
    8: [send("hand", "positions", 0.4)],
    12: [ask("cancel", {"goal": 1}), ask("cancel", {"goal": 1})],
    20: [trajectory(-0.2, 0.2, 0.5), ask("cancel", {"controller": "arm"})],
    26: [torque(["mirror"], on=False, release=True), torque(["wrist"], on=False)],
    34: [torque(["mirror"], on=True)],
    40: [switch(["standby"], ["arm", "arm_pid"])],
    50: [switch(["arm"], ["standby"])],
    52: [switch([], ["arm_pid"])],
}


def test_chains_goals_torque_and_parameters(steer: Callable[..., Path]) -> None:
    log = replayed(steer(STORY))
    assert_chains(log)
    refused = [one.refusal for one in client_commands(log) if one.refusal]
    assert len(refused) == 3, refused  # cancelled twice, torque of a commanded joint, a lower end
    names = [event.name for event in log.events]
    assert names.count("goal_accepted") == names.count("goal_ended") == 2
    active = log.cycles["active"].astype(int)
    assert {tuple(pair) for pair in pairwise((active >> 1 & 0b111).tolist())} >= {(0b011, 0b000), (0b100, 0)}


MOTIONS: dict[int, list[Command]] = {
    3: [play(0.5, 0.3)],
    9: [
        ask("parameters", {"controller": "arm_pid", "values": {"gains.p": 5.0}}),
        ask("cancel", {"controller": "hand"}),
    ],
    30: [play(-0.2, 0.5)],
    36: [send("hand", "positions", 0.1)],
}


def test_motions_are_played_again_with_the_same_numbers(
    steer: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = steer(MOTIONS)
    log = replayed(path)
    reports = [
        msgspec.json.decode(event.data, type=GoalReport)
        for event in log.events
        if event.name in ("goal_accepted", "goal_ended")
    ]
    assert [(one.goal, one.controller, one.status) for one in reports] == [
        (1, "hand", "accepted"),
        (2, "arm", "accepted"),
        (1, "hand", "cancelled"),
        (2, "arm", "reached"),
        (3, "hand", "accepted"),
        (4, "arm", "accepted"),
        (3, "hand", "preempted"),
        (4, "arm", "reached"),
    ]
    begin = Goals.__init__

    def begin_one_later(goals: Goals, *arguments: Any) -> None:
        begin(goals, *arguments)
        goals.last = 1

    monkeypatch.setattr(Goals, "__init__", begin_one_later)
    _, first = differing(path)
    assert "/goals" in first.what


def test_of_two_equal_commands_in_one_cycle_only_the_second_is_refused(steer: Callable[..., Path]) -> None:
    equal = send("hand", "positions", 0.1)
    log = replayed(steer({4: [equal, switch([], ["hand"]), equal]}))
    assert [bool(one.refusal) for one in client_commands(log)][:3] == [False, False, True]


@pytest.mark.campaign
@settings(
    max_examples=int(os.environ.get("DXLRUN_STEERED_GRAPHS", "5")),
    deadline=None,
)
@given(
    st.dictionaries(st.integers(0, CYCLES - 5), st.lists(COMMANDS, min_size=1, max_size=4), max_size=15),
    st.lists(st.tuples(st.integers(1, 4), st.integers(100, 900), st.sampled_from([20, 60, 300])), max_size=2),
)
def test_any_steered_graph(
    steer: Callable[..., Path], asked: dict[int, list[Command]], silent: list[tuple[int, int, int]]
) -> None:
    assert_chains(replayed(steer(asked, silent)))
