"""Each policy on each trigger, judged by what the simulated servos were sent."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from msgspec.structs import force_setattr
from tests.kit.line_faults import truncate_next
from tests.kit.wire import all_writes

from dxlrun.channels.answers import Code, Refusal
from dxlrun.channels.commands import LOOP, CommandMessage
from dxlrun.channels.event_records import EventRing
from dxlrun.errors import StartUpError
from dxlrun.plan.policy_plan import SLOW_SPEED
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun.testing import simulated_robot

ROBOT = """\
name: three
buses:
  main: {port: sim, protocol: 1.0, baud_rate: 1_000_000, return_delay_time: 100 us, adapter: {latency: 1 ms}}
loop: {rate: 50, overrun: stop}
joints:
  pan:
    {bus: main, id: 3, model: AX-12A, reference: 150 deg, direction: 1, limits: {position: [-1 rad, 1 rad]}}
  tilt:
    {bus: main, id: 7, model: AX-12A, reference: 150 deg, direction: -1, limits: {position: [-1 rad, 1 rad]}}
  yaw: {bus: main, id: 9, model: AX-12A, reference: 150 deg, direction: 1}
controllers:
  pair: {type: joint_group_position_controller, joints: [pan, tilt]}
  single: {type: joint_group_position_controller, joints: [yaw]}
poses:
  home: {pan: 20 deg, tilt: -10 deg}
"""
TICK = math.radians(300 / 1023)
HOME = {3: round(math.radians(170) / TICK), 7: round(math.radians(160) / TICK)}
STEPS = {
    "limp": "limp",
    "hold": "hold",
    "pose": "[{pose: home, speed: 60 deg/s}, limp]",
    "less torque": "[{reduce_torque: 0.3, steps: 3, over: 300 ms}, hold]",
}
TORQUE_ENABLE, GOAL, TORQUE_LIMIT = 24, 30, 34
LATE_S = 0.03
"""How late a cycle is in the worst of the triggers."""
START_NS = 200_000_000
"""Since the loop's first deadline, or more, when something goes wrong."""
Act = Callable[[Any, int], None]


def writes(robot: VirtualRobot) -> Iterator[tuple[int, int, int, bytes]]:
    return all_writes(robot.ledger.entries, robot.plan.buses[0])


def torque(robot: VirtualRobot) -> dict[int, bool]:
    """Return which servos have torque at the end, by the ledger."""
    state = {3: False, 7: False, 9: False}
    for _, servo, address, data in writes(robot):
        if address == TORQUE_ENABLE:
            state[servo] = bool(data[0])
    return state


def goals(robot: VirtualRobot, servo: int) -> list[tuple[int, int]]:
    """Return the goals that a servo got after its torque: time and ticks."""
    sent = [
        (t, int.from_bytes(data[:2], "little"))
        for t, one, at, data in writes(robot)
        if (one, at) == (servo, GOAL)
    ]
    return sent[1:]


def limits(robot: VirtualRobot, servo: int) -> list[int]:
    """Return the torque limits that a servo got."""
    return [
        int.from_bytes(data, "little")
        for _, one, at, data in writes(robot)
        if (one, at) == (servo, TORQUE_LIMIT)
    ]


@pytest.fixture
def built(tmp_path):
    """Build the robot with policies on virtual time."""

    def build(duration_s=60.0, more="", change=("", ""), **policies):
        said = ", ".join(f"{name}: {policy}" for name, policy in (policies | {"exit_timeout": "4 s"}).items())
        path = tmp_path / "three.yaml"
        path.write_text(ROBOT.replace(*change) + more + f"policies: {{{said}}}\n")
        return simulated_robot(path, duration_s=duration_s)

    return build


# Each trigger takes the robot before its run, and what its controllers do, and lets something happen.


def stop_signal(robot: VirtualRobot, acts: dict[str, Act]) -> None:
    robot.buses[0].at(START_NS, robot.stop.request)


def stop_verb(robot: VirtualRobot, acts: dict[str, Act]) -> None:
    robot.buses[0].at(
        START_NS, lambda: robot.inbox.waiting.append(CommandMessage(1, LOOP, "stop", b"", "anna"))
    )


def stop_in_a_pause(robot: VirtualRobot, acts: dict[str, Act]) -> None:
    robot.buses[0].at(
        START_NS, lambda: robot.inbox.waiting.append(CommandMessage(1, LOOP, "pause", b"", "anna"))
    )
    robot.buses[0].at(2 * START_NS, robot.stop.request)


def failure(robot: VirtualRobot, acts: dict[str, Act]) -> None:
    def fail(controller: Any, time_ns: int) -> None:
        if time_ns > START_NS:
            raise ValueError("no way")

    acts["single"] = fail


def overrun(robot: VirtualRobot, acts: dict[str, Act]) -> None:
    def dawdle(controller: Any, time_ns: int) -> None:
        if START_NS < time_ns < START_NS + 40_000_000:
            robot.clock.wait_until(robot.clock.now_ns() + 30_000_000)

    acts["single"] = dawdle


def silence(robot: VirtualRobot, acts: dict[str, Act]) -> None:
    robot.buses[0].at(START_NS, lambda: robot.buses[0].servo(9).silence())


def stale(robot: VirtualRobot, acts: dict[str, Act]) -> None:
    data = np.zeros(1).tobytes()
    command = CommandMessage(1, "single", "positions", data, "anna", lease_ns=100_000_000)
    robot.buses[0].at(START_NS, lambda: robot.inbox.waiting.append(command))


TRIGGERS = {
    ("on_exit", stop_signal): "stopped",
    ("on_exit", stop_verb): "stopped",
    ("on_exit", stop_in_a_pause): "stopped",
    ("on_fault", failure): "fault",
    ("on_fault", overrun): "fault",
    ("on_lost_servo", silence): "fault",
    ("on_stale_command", stale): "fault",
}
CASES = [
    pytest.param(name, trigger, reason, steps, id=f"{trigger.__name__}-{steps}")
    for (name, trigger), reason in TRIGGERS.items()
    for steps in STEPS
    if not (steps == "hold" and name in ("on_lost_servo", "on_stale_command"))
]


@pytest.mark.parametrize(("name", "trigger", "reason", "steps"), CASES)
def test_each_policy_is_done_on_each_trigger(  # noqa: PLR0917  fixtures
    built: Callable[..., VirtualRobot],
    acts: dict[str, Act],
    name: str,
    trigger: Callable[[VirtualRobot, dict[str, Act]], None],
    reason: str,
    steps: str,
) -> None:
    robot = built(**{name: STEPS[steps]})
    trigger(robot, acts)
    result = robot.run()
    assert result.reason == reason
    if name in ("on_lost_servo", "on_stale_command"):
        assert f"; {name}: " in result.detail
    assert robot.clock.now_ns() < START_NS * 2 + 4_500_000_000
    if steps in ("limp", "pose"):
        assert not any(torque(robot).values())
        assert result.last == "limp"
    else:
        assert all(torque(robot).values())
        assert result.last == "hold"
    if steps == "pose":
        check_pose(robot)
    if steps == "less torque":
        assert limits(robot, 3) == limits(robot, 7) == [784, 546, 307]
        assert goals(robot, 3)[-1][1] == goals(robot, 3)[0][1]
    else:
        assert limits(robot, 3) == []


def check_pose(robot: VirtualRobot) -> None:
    """The last goals are the pose, they came there at its speed, and the servos are near."""
    for servo, ticks in HOME.items():
        sent = goals(robot, servo)
        assert sent[-1][1] == ticks
        moving = [(t, now) for (t, now), (_, after) in itertools.pairwise(sent) if now != after]
        there_ns = next(t for t, now in sent if now == ticks)
        way, time_s = abs(ticks - moving[0][1]) * TICK, (there_ns - moving[0][0]) * 1e-9
        assert time_s > way / math.radians(60) - LATE_S
        steps = [abs(after - now) * TICK for (_, now), (_, after) in itertools.pairwise(sent)]
        assert max(steps) < math.radians(60) * (0.02 + LATE_S) + TICK
        assert robot.buses[0].servo(servo).shaft_angle == pytest.approx(ticks * TICK, abs=0.1)
    assert goals(robot, 9)[-1][1] == goals(robot, 9)[0][1]


def test_a_pose_after_a_pause_begins_slowly(built):
    robot = built(on_exit="[{pose: home, speed: 180 deg/s}, limp]")
    pause = CommandMessage(1, LOOP, "pause", b"", "anna")
    robot.buses[0].at(2_000_000_000, lambda: robot.inbox.waiting.append(pause))
    robot.buses[0].at(2_500_000_000, robot.stop.request)
    assert robot.run().reason == "stopped"
    sent = goals(robot, 3)
    assert sent[-1][1] == HOME[3]
    steps = [abs(after - now) * TICK for (_, now), (_, after) in itertools.pairwise(sent)]
    assert max(steps) < SLOW_SPEED * 0.02 + TICK


def test_the_end_of_a_run_is_an_exit(built):
    robot = built(duration_s=0.5, on_exit=STEPS["pose"])
    assert robot.run().reason == "ended"
    check_pose(robot)
    assert not any(torque(robot).values())


def test_controllers_are_deactivated_before_a_policy_moves(built, acts):
    active: list[int] = []
    robot = built(on_exit=STEPS["pose"])
    stop_signal(robot, acts)
    last = robot.robot.loop.sink.append_cycle
    seen: list[tuple[int, bool]] = []

    class Sink:
        append_activation = staticmethod(robot.robot.loop.sink.append_activation)
        wake = staticmethod(robot.robot.loop.sink.wake)

        def append_cycle(self, record):
            seen.append((record.active, bool(np.isfinite(record.commands.position).any())))
            last(record)

    acts["pair"] = lambda controller, time_ns: active.append(time_ns)
    robot.robot.loop.sink = Sink()
    robot.run()
    during = [mask for mask, _ in seen[len(active) :]]
    assert len(during) > 10
    assert set(during) == {0}
    assert all(mask == 0b11 for mask, _ in seen[: len(active)])


def test_a_request_during_a_policy_is_refused_because_the_run_ends(built, acts):
    robot = built(on_exit=STEPS["pose"])
    stop_signal(robot, acts)
    switch = CommandMessage(1, LOOP, "switch", b'{"deactivate":["pair"]}', "anna")
    robot.buses[0].at(START_NS + 100_000_000, lambda: robot.inbox.waiting.append(switch))
    robot.run()
    assert robot.inbox.answers == {1: Refusal(Code.RUN_ENDING)}
    check_pose(robot)


@pytest.mark.parametrize("seen", [False, True])
def test_a_joint_that_cannot_reach_its_pose_is_said_and_does_not_keep_the_robot_from_its_end(
    built, acts, seen, monkeypatch
):
    robot = built(on_exit=STEPS["pose"])
    stop_signal(robot, acts)
    bus, servo = robot.buses[0], robot.buses[0].servo(3)
    servo.wakes_on_goal = False
    cut, lose = lambda: servo.poke("torque_enable", 0), lambda: servo.cut_power(START_NS - 50_000_000)
    bus.at(START_NS - 100_000_000, lose if seen else cut)
    said: list[str] = []
    monkeypatch.setattr(
        EventRing, "emit_event", lambda ring, source, event, data=b"": said.append(event.text)
    )
    robot.run()
    assert servo.shaft_angle < (HOME[3] - 20) * TICK
    limp = "is limp: it was reset, its torque was cut, or it shut itself down"
    assert [text for text in said if "not reached" in text] == [
        "on_exit: pose home at 60 deg/s is not reached: joint pan "
        f"{limp if seen else 'is 0.352 rad off'}; now limp"
    ]
    assert robot.clock.now_ns() < START_NS + 2_600_000_000
    assert not any(torque(robot).values())


def test_a_reply_that_is_lost_as_the_pose_is_reached_does_not_end_it_before_the_servo_has_its_goal(
    built, acts
):
    robot = built(on_exit=STEPS["pose"])
    stop_signal(robot, acts)
    robot.run()
    there_ns = next(t for t, now in goals(robot, 3) if now == HOME[3])
    robot = built(on_exit=STEPS["pose"])
    stop_signal(robot, acts)
    bus, servo = robot.buses[0], robot.buses[0].servo(3)
    bus.at(there_ns - 30_000_000, servo.silence)
    bus.at(there_ns + 10_000_000, lambda: servo.silence(False))
    robot.run()
    assert goals(robot, 3)[-1][1] == HOME[3]
    assert servo.shaft_angle == pytest.approx(HOME[3] * TICK, abs=0.1)


def test_steps_are_cut_short_when_the_time_for_them_is_over(built, acts):
    robot = built(on_exit="[{pose: home, speed: 30 deg/s}, hold]")
    stop_signal(robot, acts)
    force_setattr(robot.plan.loop.policies, "limit_ns", 200_000_000)
    assert robot.run().last == "hold"
    assert goals(robot, 3)[-1][0] < START_NS + 400_000_000
    assert goals(robot, 3)[0][1] < goals(robot, 3)[-1][1] < HOME[3]
    assert all(torque(robot).values())


def test_periods_are_skipped_behind_the_end_of_the_motions_too(built):
    robot = built(duration_s=0.2, on_exit=STEPS["pose"])
    hardware, clock = robot.robot.hardware, robot.clock
    read, woken = hardware.read_states, []

    def slow():
        woken.append(robot.record.woken_ns)
        if len(woken) == 22:
            clock.wait_until(clock.now_ns() + 90_000_000)
        read()

    hardware.read_states = slow  # type: ignore[method-assign]
    result = robot.run()
    assert result.skipped == 4
    assert np.diff(woken[10:]).min() >= 20_000_000, "two cycles never follow each other in a burst"


@pytest.mark.parametrize(("rate", "refused"), [(1.0, True), (25.0, False)])
def test_a_rate_at_which_the_policies_would_not_end_in_time_is_refused(built, rate, refused):
    robot = built(duration_s=0.1, on_exit="[{pose: home, speed: 30 deg/s}, limp]")
    robot.inbox.waiting.append(CommandMessage(1, LOOP, "rate", f'{{"rate": {rate}}}'.encode(), "anna"))
    robot.run()
    answer = robot.inbox.answers[1]
    assert (isinstance(answer, Refusal) and answer.code is Code.RATE_UNDER_EXIT) is refused


@pytest.mark.parametrize("steps", ["pose", "less torque"])
def test_without_a_line_its_servos_are_lost_and_the_policy_for_them_ends_the_run(built, steps):
    robot = built(on_lost_servo=STEPS[steps])
    robot.buses[0].at(START_NS, robot.buses[0].unplug)
    result = robot.run()
    assert (result.reason, result.last) == ("fault", "limp" if steps == "pose" else "hold")
    assert "pan, tilt, yaw missed at least 3 replies in a row" in result.detail
    assert limits(robot, 3) == []
    assert len(robot.failures) == (3 if steps == "pose" else 0)


@pytest.mark.parametrize("policies", [{}, {"on_fault": STEPS["less torque"]}])
def test_a_start_restores_a_torque_limit_that_is_lowered(built, policies):
    robot = built(duration_s=0.1, **policies)
    robot.buses[0].servo(7).poke("torque_limit", 307)
    robot.run()
    assert limits(robot, 7) == [1023]
    assert limits(robot, 3) == []
    order = [at for _, servo, at, _ in writes(robot) if servo == 7]
    assert order[:3] == [GOAL, TORQUE_ENABLE, TORQUE_LIMIT], (
        "a weak servo may have sagged: its goal comes first"
    )


def test_a_start_ends_when_a_servo_may_be_left_weak(built):
    robot = built(duration_s=0.1, on_fault=STEPS["less torque"])
    bus = robot.buses[0]
    bus.servo(7).poke("torque_limit", 307)
    receive = bus.receive_bytes

    def heard(data, at_ns):
        if data[2] == 7 and data[4:-1] == b"\x02\x22\x02":
            truncate_next(bus, 7, 0)
        receive(data, at_ns)

    bus.receive_bytes = heard  # type: ignore[method-assign]
    said = "tilt (ID 7 on bus main) did not answer when its torque limit was read"
    with pytest.raises(StartUpError, match=re.escape(said)):
        robot.run()
    assert not any(torque(robot).values())


CURL = (
    "single: {type: joint_group_position_controller, joints: [yaw]}",
    "single: {type: keyframe_player, joints: [yaw], ACTIVE, motions: {curl: {steps: ["
    "{time: 200 ms, pose: {yaw: 5 deg}, torque: {yaw: 0.5}}, "
    "{time: 200 ms, pose: {yaw: -5 deg}, torque: {yaw: 0.2}}]}}}",
)


def test_poses_of_protocol_1_limit_the_torque_and_the_mode_after_them_gives_it_back(built):
    change = CURL[0], CURL[1].replace("ACTIVE", "start: curl")
    robot = built(
        duration_s=1.0,
        change=change,
        on_exit="[{pose: level, speed: 60 deg/s}, hold]",
        more="  level: {yaw: 0 deg}\n",
    )
    robot.buses[0].servo(9).poke("max_torque", 800)
    robot.run()
    assert [ticks for ticks, _ in itertools.groupby(limits(robot, 9))] == [800, 512, 205, 800]
    assert limits(robot, 3) == []
    assert all(torque(robot).values())


def test_a_start_gives_back_the_torque_that_a_pose_of_an_earlier_run_took(built):
    robot = built(duration_s=0.1, change=(CURL[0], CURL[1].replace("ACTIVE", "active: false")))
    robot.buses[0].servo(9).poke("torque_limit", 205)
    robot.run()
    assert limits(robot, 9) == [1023]


def test_less_torque_is_a_fraction_of_what_the_servo_may_by_itself(built, acts):
    robot = built(on_exit=STEPS["less torque"])
    robot.buses[0].servo(3).poke("max_torque", 500)
    stop_signal(robot, acts)
    robot.run()
    assert limits(robot, 3) == [500, 383, 267, 150]  # first at the start-up


def test_on_protocol_2_the_pwm_is_reduced(tmp_path):
    path = tmp_path / "one.yaml"
    path.write_text(
        "name: one\n"
        "buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, return_delay_time: 100 us}}\n"
        "loop: {rate: 50}\n"
        "joints: {pan: {bus: main, id: 3, model: XM430-W350, reference: 180 deg, direction: 1}}\n"
        "policies: {on_exit: [{reduce_torque: 0.4, steps: 2, over: 200 ms}, hold]}\n"
    )
    (robot := simulated_robot(path, duration_s=0.2)).run()
    sent = b"".join(entry.data for entry in robot.ledger.entries if entry.direction == "in")
    parts = sent.split(bytes((0x83, 100, 0, 2, 0, 3)))[1:]  # sync write, Goal PWM (100), two bytes, servo 3
    assert [int.from_bytes(part[:2], "little") for part in parts] == [round(885 * 0.7), round(885 * 0.4)]
    assert robot.buses[0].servo(3).torque_on
