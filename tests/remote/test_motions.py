# ruff: noqa: E501 (motions and their mistakes are read best side by side)

"""Motions for a robot that runs: the way to the first poses, and the speed; refusals: sessions/motions.txt."""

import asyncio
import json
import time
from contextlib import suppress
from itertools import pairwise

import numpy as np
import pytest
from msgspec.structs import replace

from dxlrun.channels.answers import Completion
from dxlrun.control.controllers.plugin_loading import Offer, PlugIns
from dxlrun.plan.loop_plan import ControllerPlan, JointPlan
from dxlrun.remote import gateway
from dxlrun.remote.preparation import Preparation
from dxlrun.remote.requests.request_table import Role
from dxlrun_controllers.motions.joint_trajectory_controller import JointTrajectoryController
from dxlrun_controllers.motions.keyframe_player import KeyframePlayer


@pytest.fixture
def head(desk_of):
    """A desk with controllers of four types; the last two are not active. Both joints are at 0.2 rad."""
    desk = desk_of("../sessions/motions.txt")
    activate(desk, "positions", "posvel")
    for array in desk.record.goals.values:
        array.fill(np.nan)
    desk.record.states.position[:] = 0.2
    desk.finish_cycle()
    return desk


def activate(desk, *names):
    desk.record.active = sum(1 << [*desk.link.controllers].index(name) for name in names)
    desk.finish_cycle()


def play(desk, text, speed=1.0, file="wave.yaml"):
    """Return status, answer, and what the loop got: (controller, kind, times in s, arrays, end in s)."""
    before = len(desk.taken)
    status, answer = desk.ask("POST", "/play", {"text": text, "speed": speed, "file": file})
    if len(desk.taken) == before:
        return status, answer, []
    head, _, numbers = desk.taken[-1].data.partition(b"\n")
    values, found = np.frombuffer(numbers), []
    for part in json.loads(head)["parts"]:
        arrays = np.split(values[: sum(part["sizes"])], np.cumsum(part["sizes"])[:-1])
        values = values[sum(part["sizes"]) :]
        times = np.array(part["at_ns"]) * 1e-9
        found.append((part["controller"], part["kind"], times, arrays, part["end_ns"] * 1e-9))
    assert not len(values)
    return status, answer, found


NOD = """name: nod
motions:
  - controller: positions
    points:
      - {time: 0 s, joints: {pan: {position: 0.7 rad}}}
      - {time: 1 s, joints: {pan: {position: 0.1 rad}}}
  - controller: posvel
    start: 1 s
    points:
      - {time: 0 s, joints: {tilt: {position: 0.1 rad, velocity: 1 rad/s}}}
      - {time: 1 s, joints: {tilt: {position: 0.5 rad, velocity: 1 rad/s}}}
"""


def test_a_motion_begins_softly_when_the_slowest_joint_is_there(head):
    real = head.mailbox.answer_command
    head.mailbox.answer_command = lambda number, _: real(number, Completion(7, goals=(4, 5)))
    status, answer, (positions, posvel) = play(head, NOD)
    assert (status, answer) == (200, {"done": True, "cycle": 7, "goals": [4, 5], "seconds": 4.4})
    name, kind, times, arrays, end = positions
    assert (name, kind) == ("positions", "positions")
    assert end == pytest.approx(2.3), "it is judged when the last way is over at the highest speed"
    ramp = [array[0] for array in arrays]
    assert ramp[0] == 0.2
    assert max(np.diff(ramp[:-1])) <= 0.5 * 0.02 + 1e-9
    assert times[-2:].tolist() == [1.0, 2.0]  # 0.5 rad at 0.5 rad/s
    assert ramp[-2:] == [0.7, 0.1]
    assert all(later > before for before, later in pairwise(times))
    name, kind, times, arrays, end = posvel
    assert (name, kind) == ("posvel", "posvel")
    assert end == pytest.approx(3.4), "the last 0.4 rad take 0.4 s"
    assert times.tolist() == [0.0, 2.0, 3.0]
    np.testing.assert_allclose(arrays[0], [0.1, 0.05])
    np.testing.assert_allclose(arrays[1:], [[0.1, 1.0], [0.5, 1.0]])
    assert head.taken[-1].origin.endswith(": wave.yaml")


@pytest.mark.parametrize("speed", [0.5, 2.0])
def test_the_speed_scales_times_and_velocities(head, speed):
    _, answer, (positions, posvel) = play(head, NOD, speed)
    lead = 1.0
    np.testing.assert_allclose(positions[2][-2:], [lead, lead + 1 / speed])
    np.testing.assert_allclose(posvel[2][-2:], [lead + 1 / speed, lead + 2 / speed])
    np.testing.assert_allclose(posvel[3][1:], [[0.1, speed], [0.5, speed]])
    assert answer["seconds"] == pytest.approx(lead + 2.4 / speed + 1)


def test_a_trajectory_is_one_goal_with_its_parts_in_a_row(head):
    activate(head, "positions", "arm")
    text = """name: two
motions:
  - controller: arm
    start: 2 s
    points: [{time: 500 ms, joints: {tilt: {position: 0.4 rad, velocity: 0 rad/s, acceleration: 0 rad/s^2}}}]
  - controller: arm
    points:
      - {time: 0 s, joints: {tilt: {position: 0.3 rad, velocity: 0 rad/s, acceleration: 0 rad/s^2}}}
      - {time: 1 s, joints: {tilt: {position: 0.2 rad, velocity: 0.1 rad/s, acceleration: 0.4 rad/s^2}}}
"""
    status, answer, (arm,) = play(head, text, 0.5)
    assert status == 200, answer
    assert arm[:2] == ("arm", "trajectory")
    assert arm[2].tolist() == [0.0]
    points = [  # half as fast: half of the velocity, and a quarter of the acceleration
        {"time": time, "positions": [at], "velocities": [speed], "accelerations": [rise]}
        for time, at, speed, rise in ((0.0, 0.3, 0.0, 0.0), (2.0, 0.2, 0.05, 0.1), (5.0, 0.4, 0.0, 0.0))
    ]
    command = JointTrajectoryController.Commands["trajectory"](points=points, start_in=0.2)
    parameters = JointTrajectoryController.Parameters(joints=("tilt",))
    np.testing.assert_allclose(
        arm[3][0], JointTrajectoryController.prepare("trajectory", command, parameters), atol=1e-12
    )


def test_wheels_have_no_way_to_a_first_pose(head):
    activate(head, "wheel")
    text = "name: roll\nmotions:\n  - controller: wheel\n    points: [{time: 0 s, joints: {tilt: {velocity: 1 rad/s}}}]\n"
    _, answer, (wheel,) = play(head, text)
    assert (wheel[2].tolist(), wheel[3][0].tolist(), answer["seconds"]) == ([0.0], [1.0], 1.0)


POINT = "    points: [{time: 0 s, joints: {%s}}]\n"
HEAD = "name: nod\nmotions:\n  - controller: %s\n"


def test_a_motion_that_is_too_long_is_refused(head, monkeypatch):
    monkeypatch.setattr(
        gateway, "MOTION_S", 100.0
    )  # its length is refused, however long a busy machine takes
    text = HEAD % "positions" + "    duration: 9 s\n    samples: 20000\n    joints: {pan: {position: 0.2}}\n"
    status, answer, taken = play(head, text)
    assert (status, answer["code"], taken) == (413, "too_long", [])


# While a motion is checked


def brood(*_):
    while True:
        with suppress(Exception):
            time.sleep(0.01)


def test_a_motion_that_takes_long_to_check_keeps_no_stop_waiting(head, monkeypatch):
    monkeypatch.setattr(gateway, "schedule_motion", brood)
    monkeypatch.setattr(gateway, "MOTION_S", 1.0)

    async def stop_meanwhile():
        body = {"text": NOD}
        playing = asyncio.ensure_future(head._ask_and_answer(None, ("POST", "/play", body), {}))
        await asyncio.sleep(0)
        stopped = await head.request("POST", "/stop")
        return stopped, playing.done(), await playing

    (status, _), ended, (slow, answer) = asyncio.run(stop_meanwhile())
    assert (status, ended) == (200, False)
    assert (slow, answer["code"]) == (422, "too_slow")
    assert [command.kind for command in head.taken] == ["stop"]


def test_a_motion_is_not_played_for_a_client_that_has_hung_up_meanwhile(head):
    body = json.dumps({"text": NOD}).encode()
    chunks = [{"type": "http.request", "body": body}, {"type": "http.disconnect"}]
    assert head.ask("POST", "/play", chunks=chunks)[0] == 400
    chunks = [{"type": "http.request", "body": body}]
    assert head.ask("POST", "/play", chunks=chunks)[0] == 200
    assert [command.kind for command in head.taken] == ["play"]


def test_a_motion_is_not_played_for_a_client_that_lost_the_command_meanwhile(head, monkeypatch):
    real = gateway.computed

    async def computed(*words):
        await head.request("POST", "/take-over", client=("anna", Role.ADMIN))
        return await real(*words)

    monkeypatch.setattr(gateway, "computed", computed)
    status, answer = head.ask("POST", "/play", {"text": NOD}, client=("bert", Role.COMMAND))
    assert (status, answer["code"]) == (409, "commanded_by")
    assert {one.kind for one in head.taken} == {"commander"}


def test_a_failure_in_the_check_of_a_motion_is_that_of_one_request(head, monkeypatch):
    monkeypatch.setattr(gateway, "schedule_motion", lambda *_: {}["no"])
    status, answer, _ = play(head, NOD)
    assert (status, answer["code"], answer["fields"]["problem"]) == (500, "gateway_failed", "KeyError: 'no'")
    monkeypatch.undo()
    assert play(head, NOD)[0] == 200


@pytest.mark.parametrize(
    ("position", "seconds", "goal", "velocity"),
    [
        (0.204, 0.0, None, None),  # a few ticks take no time, and a short way takes its least one
        (0.206, 0.2, None, None),
        (0.22, 0.2, None, None),
        (0.4, 0.4, None, None),
        (0.7, 2.0, None, 0.25),  # a joint that is slower than the soft speed gets its own time
        (0.7, 0.5, 0.45, None),  # from the goal of a joint, and not from where it lags behind
    ],
)
def test_the_way_to_a_first_pose_takes_its_time(head, position, seconds, goal, velocity):
    joints = head.gateway._preparation.joints
    joints["pan"] = replace(joints["pan"], velocity=velocity or joints["pan"].velocity)
    head.record.goals.position[0] = goal or np.nan
    head.finish_cycle()
    text = HEAD % "positions" + POINT % f"pan: {{position: {position} rad}}"
    status, answer, found = play(head, text)
    assert status == 200, answer
    ((_, _, times, arrays, _),) = found
    assert times[-1] == pytest.approx(seconds)
    assert seconds == 0.0 or arrays[0][0] == (goal or 0.2)


def test_motion_that_loops_has_no_length():
    steps = [{"time": "500 ms", "pose": {"pan": "0 rad"}}]
    motions = {"once": {"steps": steps}, "round": {"steps": steps, "next": "round", "exit": "once"}}
    player = PlugIns({"player": Offer("player", KeyframePlayer, "tests 1")}, {})
    keys = json.dumps({"joints": ["pan"], "motions": motions})
    plan = ControllerPlan("pages", "player", "tests 1", keys, ("pan",), ("position",), (), True, 1)
    prepared = Preparation({"pan": JointPlan("pan", -1.0, 1.0, 2.0)}, player)
    assert prepared.motions(plan) == {"once": 0.5, "round": None}
