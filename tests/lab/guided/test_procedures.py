"""Procedures on virtual time: what a segment plays and records; what ends one early, with the rest kept."""

import random
import re
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.kit.campaigns import campaign
from tests.kit.experiments import Plays, Segments, perform, sine, state_of

from dxlrun.channels.commands import LOOP, CommandMessage
from dxlrun.errors import DxlrunError, Refused
from dxlrun.log.log_reader import read_log
from dxlrun.tooling.live import RunGone
from dxlrun_lab.guided import experiment
from dxlrun_lab.guided.choice import situation_of
from dxlrun_lab.guided.experiment import perform_experiment
from dxlrun_lab.guided.rig import RunningController
from dxlrun_lab.guided.segment import Guard, Segment
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript

pytestmark = pytest.mark.long


def test_a_segment_is_recorded_cycle_by_cycle_as_in_the_log(single, tmp_path):
    plays, done = perform(single, "joint", lambda joint: iter([sine(joint, settle_s=0.1)]))
    (got,) = plays.got
    assert done.recorded == (got,)
    assert len(got) == 320 + 32 + 1
    assert np.array_equal(np.diff(got.of_cycles("cycle")), np.ones(352))
    wave = 0.2 * np.sin(2 * np.pi * np.arange(320) / 320)
    assert np.abs(got.goal[:320, 0] - wave).max() < 1e-9
    assert got.time[-1] == pytest.approx(1.1)
    assert got.valid.all()
    assert (got.of_joints("voltage")[-1, 0], got.of_joints("temperature")[-1, 0]) == (12.0, 30.0)
    assert 0.2 - 0.05 < got.position.max() < 0.2 + 0.01
    single.close()
    log = read_log(tmp_path / "0.mcap")
    rows = np.isin(log.cycles["cycle"], got.of_cycles("cycle"))
    for name in ("cycle", "woken_ns", "written_ns", "position", "age_ns", "valid"):
        assert np.array_equal(log.cycles[name][rows], got.cycles[name]), name
    assert np.array_equal(log.cycles["goal_position"][rows, :1], got.goal)
    for cycle, name in ((0, "goal_accepted"), (-1, "goal_ended")):
        (event,) = [event for event in log.events if event.name == name]
        assert got.of_cycles("woken_ns")[cycle] <= event.t_ns <= got.of_cycles("written_ns")[cycle]


def test_a_long_table_at_another_rate_is_sent_in_pieces(single):
    """As many rows as 60 s at 320 Hz, as an identification needs; the loop runs at a fifth of its rate."""
    rows = 0.2 * np.sin(np.arange(19_200) / 1000.0)
    segment = Segment("long", 1 / 3200, {"joint": rows}, loop_rate=64)
    plays, _ = perform(single, "joint", lambda joint: iter([segment]))
    (got,) = plays.got
    assert len(got) == 385
    assert np.abs(got.goal[:384, 0] - rows[::50]).max() < 1e-9


def test_what_the_run_refuses_returns_to_the_procedure(single, arm):
    pwm = Segment("v", 0.01, {"joint": np.zeros(3)}, interface="pwm")
    plays, done = perform(single, "joint", lambda joint: iter([pwm]))
    assert plays.refused == ["joint joint (ID 1 on bus main) has no pwm mode: MX-64 lacks the mode"]
    assert (done.why, done.recorded) == ("", ())
    rates = (160, 200)
    plays, done = perform(arm, "elbow", lambda joint: (sine(joint, loop_rate=rate) for rate in rates))
    assert plays.refused == [
        "160 Hz is not a multiple of 50 Hz, the rate of controller joint_state_broadcaster; "
        "choose another rate"
    ]
    assert (done.why, len(plays.got)) == ("", 1)


def test_interfaces_follow_each_other_and_the_chain_is_active_again(arm):
    def constant(name, value, rows, **more):
        return Segment(name, 1 / 400, {"elbow": np.full(rows, value)}, interface=name, **more)

    def segments(joint):
        yield sine(joint, 400)
        yield constant("effort", 0.05, 100)
        yield constant("velocity", -0.5, 100)
        yield constant("pwm", 0.1, 40, begin={"elbow": 0.2})

    plays, done = perform(arm, "elbow", segments)
    assert done.why == ""
    push, turn, voltage = plays.got[1:]
    assert push.goal[:100, 0].tolist() == pytest.approx([0.05] * 100, abs=0.002)
    assert turn.goal[50, 0] == pytest.approx(-0.5, abs=0.03)
    assert voltage.position[0, 0] == pytest.approx(0.2, abs=0.03)
    assert (voltage.goal[:40, 0] > 0.09).all()


def test_joints_are_led_to_the_first_row_slowly_and_back(single):
    places = []
    goals = single.robot.link.simulated.record.goals
    single.robot.link.each_cycle = lambda cycle: places.append(float(goals.position[0]))
    far = Segment("far", 1 / 320, {"joint": np.full(10, np.radians(30))})
    plays, _ = perform(single, "joint", lambda joint: iter([far]))
    assert plays.got[0].goal[0, 0] == pytest.approx(np.radians(30))
    assert np.abs(np.diff(places)).max() * 50 < 0.55, "rows of an approach are 20 ms apart"
    assert places[-1] == pytest.approx(0.0, abs=0.006)


def test_a_joint_that_leaves_its_range_ends_the_experiment_and_the_rest_is_kept(arm):
    def segments(joint):
        yield sine(joint, 400)
        yield Segment("push", 1 / 400, {joint.name: np.full(4000, 0.9)}, interface="effort")
        raise AssertionError("nothing follows")

    plays, done = perform(arm, "elbow", segments)
    assert "joint elbow is at 0.5" in done.why
    assert "outside its range of -0.5236 to 0.5236 rad" in done.why
    assert [part.outcome for part in done.recorded] == ["reached", "aborted"]
    assert done.recorded[1].position.max() > 0.5236
    assert len(plays.got) == 1


@pytest.mark.parametrize(
    ("guard", "sentence"),
    [
        (Guard(temperature=29.0), "joint elbow has 30 deg C, more than 29"),
        (Guard(effort=0.01), "joint elbow exerts"),
    ],
)
def test_the_guard_of_a_segment_ends_it(arm, guard, sentence):
    _, done = perform(arm, "elbow", lambda joint: iter([sine(joint, 400, guard=guard)]))
    assert sentence in done.why
    assert not done.recorded[0].whole


@pytest.mark.parametrize(
    "wrong",
    [{"a": np.zeros(2), "b": np.zeros(3)}, {"a": np.zeros(0)}, {}, {"a": np.array([np.nan])}],
    ids=["lengths", "no row", "no joint", "nan"],
)
def test_wrong_tables_are_no_segments(wrong):
    with pytest.raises(ValueError, match="t: "):
        Segment("t", 0.01, wrong)


def interrupted(rig: Any, act: Callable[[], object]) -> Segments:
    """Return two segments, in the second of which something happens after half a second."""

    def segments(joint):
        yield sine(joint, 400)
        bus, now_ns = rig.robot.link.simulated.buses[0], rig.robot.link.simulated.clock.now_ns()
        bus.at(now_ns + 500_000_000, act)
        yield sine(joint, 400, 3.0)
        raise AssertionError("nothing follows")

    return segments


def happen(rig: Any, fault: str) -> None:
    script = FaultScript(())
    script.attach(rig.robot.link.simulated.buses)
    script.add(parse_fault(fault), rig.robot.link.simulated.clock.now_ns())


@pytest.mark.parametrize(
    ("fault", "why", "valid"),
    [
        # the runtime holds controllers of lost joints, so the player itself cannot end its goal
        ("silence servo=2 for=3s", r"joint elbow (\(ID 2 on bus main\) is lost|.* for 100 ms)", [False]),
        ("overheat servo=2 celsius=75", "joint elbow has 75 deg C, more than 70", [True]),
    ],
    ids=["lost", "hot"],
)
def test_a_servo_that_is_lost_or_hot_ends_it_and_what_was_measured_is_kept(arm, fault, why, valid):
    _, done = perform(arm, "elbow", interrupted(arm, lambda: happen(arm, fault)))
    assert re.fullmatch(why, done.why)
    first, last = done.recorded
    assert (first.whole, last.whole, last.valid[-1].tolist()) == (True, False, valid)
    assert 150 < np.count_nonzero(last.valid[:, 0]) < (250 if valid == [False] else 1200)
    assert np.nanmax(last.of_joints("temperature")) == (30 if valid == [False] else 75)


def test_a_joint_whose_torque_is_switched_off_ends_it(arm):
    data = msgspec.json.encode({"joints": ["elbow"], "on": False, "release": True})
    off = CommandMessage(1_000_000, LOOP, "torque", data, "a person")
    plays = Plays(interrupted(arm, lambda: arm.robot.link.gateways_link._mailbox.post_command(off)))
    done = perform_experiment(arm, plays, situation_of(arm, ["elbow"], {}))
    assert done.why == "experiment_position was deactivated"
    assert [part.whole for part in done.recorded] == [True, False]
    (sentence,) = done.not_restored  # its controllers cannot be active without torque
    assert "elbow" in sentence
    assert not [one for one in arm.controllers() if one.name.startswith("experiment")]


def test_a_run_that_ends_in_the_middle_ends_it(arm):
    link = arm.robot.link
    cycles = link.simulated.cycles
    assert arm.rate == 400
    assert arm.joints()
    assert link.simulated.cycles == cycles, "a look takes no cycle"
    plays = Plays(interrupted(arm, link.simulated.stop.request))
    done = perform_experiment(arm, plays, situation_of(arm, ["elbow"], {}))
    assert done.why == "the run ended"
    assert done.not_restored == ("the run of effort_arm ended, so the run was not restored",)
    assert [part.outcome for part in done.recorded] == ["reached", "aborted"]
    assert len(done.recorded[1]) == pytest.approx(200, abs=15)
    assert arm.joints()
    for asked in (arm.change_rate, arm.robot.rate):
        with pytest.raises(RunGone, match="the run of effort_arm ended"):
            asked(100)


class HalfRestored:
    """A rig of two joints, one of which lost its torque: its controller cannot be activated."""

    rate = 50.0

    def __init__(self) -> None:
        self.calls: list[tuple[str, ...]] = []

    def controllers(self):
        players = [RunningController("experiment_position", True, ("a", "b"))]
        players += [RunningController("experiment_pwm", False, ("a", "b"))]
        mine = [RunningController(f"arm_{joint}", not self.calls, (joint,)) for joint in "ab"]
        return (*players, *mine)

    def switch(self, activate, deactivate):
        self.calls.append(("switch", *activate, *(f"-{name}" for name in deactivate)))
        if "arm_a" in activate:
            raise Refused("joint a has no torque", code="no_torque")

    def unload_controller(self, name):
        self.calls.append(("unload", name))
        if name == "experiment_position":
            raise Refused("the robot is busy", code="busy")


def test_what_cannot_be_put_back_keeps_nothing_else_from_it():
    """The other joint's controller is activated, and all players are unloaded."""
    rig, situation = HalfRestored(), type("Situation", (), {"names": ("a", "b")})()
    stage = experiment._Stage(rig, situation, lambda: None)
    stage._players |= {("position", Guard()): "experiment_position", ("pwm", Guard()): "experiment_pwm"}
    rig.calls.append(("the experiment",))
    assert stage.restore() == ("joint a has no torque", "the robot is busy")
    assert rig.calls[1:] == [
        ("switch", "arm_a", "arm_b", "-experiment_position"),
        ("switch", "-experiment_position"),
        ("switch", "arm_a"),
        ("switch", "arm_b"),
        ("unload", "experiment_position"),
        ("unload", "experiment_pwm"),
    ]


def test_a_procedure_that_fails_leaves_the_run_as_it_was(arm):
    def fails(error):
        def segments(joint):
            yield sine(joint, 200, loop_rate=200, interface="position")
            raise error

        return segments

    _, done = perform(arm, "elbow", fails(DxlrunError("no two responses are alike")))
    assert (done.why, len(done.recorded)) == ("no two responses are alike", 1)
    before = state_of(arm)
    with pytest.raises(ZeroDivisionError):
        perform(arm, "elbow", fails(ZeroDivisionError()))
    assert state_of(arm) == before


def test_an_abort_moves_nothing_before_the_first_segment_and_cancels_the_goal_of_one(arm):
    """So that the joints come to rest before the player leaves."""
    places, goals = [], arm.robot.link.simulated.record.goals
    arm.robot.link.each_cycle = lambda cycle: places.append(float(goals.position[1]))
    far = Segment("far", 0.01, {"elbow": np.full(10, np.radians(30))})
    _, done = perform(arm, "elbow", lambda joint: iter([far]), lambda: "a key")
    assert (done.why, done.recorded, set(places)) == ("a key", (), set())
    at_s = arm.now_s + 1.5
    _, done = perform(
        arm,
        "elbow",
        lambda joint: iter([sine(joint, 400, 10.0)]),
        lambda: "a key" if arm.now_s >= at_s else None,
    )
    assert done.why == "a key"
    assert arm.robot.goals()[-1].status == "cancelled"


def many(rng: random.Random) -> Any:
    """Return segments in random order: each interface, rates, approaches."""

    def segments(joint):
        def rows(value: float) -> dict[str, np.ndarray]:
            return {joint.name: np.full(120, value)}

        parts = [
            sine(joint, 400),
            sine(joint, 200, loop_rate=200),
            Segment("up", 1 / 400, rows(joint.inner[1])),
            Segment("down", 1 / 400, rows(joint.inner[0]), interface="posvel", speeds=rows(1.0)),
            Segment("push", 1 / 400, rows(0.05), interface="effort", loop_rate=100),
            Segment("turn", 1 / 400, rows(0.3), interface="velocity"),
            Segment("voltage", 1 / 400, rows(0.05), interface="pwm", begin={joint.name: joint.middle}),
        ]
        rng.shuffle(parts)
        yield from parts

    return segments


@campaign(ci=3, night=40, release=200)
def test_an_abort_at_any_time_leaves_the_run_as_it_was(arm, number, chance):
    """On the way to a start, in a segment, while modes change or a player is loaded."""
    simulated, begin_s = arm.robot.link.simulated, arm.now_s
    at_s, lost_s = (begin_s + chance.uniform(0.0, 9.0) for _ in range(2))
    loses = number % 3 == 2  # a servo, which is back before all is restored
    print(f"aborted after {at_s - begin_s} s, lost after {lost_s - begin_s if loses else None} s")
    if loses:
        simulated.buses[0].at(round(lost_s * 1e9), lambda: happen(arm, "silence servo=2 for=200ms"))

    _, done = perform(arm, "elbow", many(chance), lambda: "aborted by a key" if arm.now_s >= at_s else None)
    assert done.why == "" or done.why.startswith(("aborted by a key", "joint elbow "))
    assert all(part.whole for part in done.recorded[:-1])
    assert not simulated.robot.loop.steering.inbox.drain_commands()
    limit_s = arm.now_s + 1.0
    while arm.now_s < limit_s:
        arm.robot.link.run_cycle()
    assert abs(simulated.record.states.velocity[1]) < 0.05, "the controllers of before hold it"
