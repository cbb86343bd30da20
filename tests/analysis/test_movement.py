"""Joints that do not do what they are told, and joints that only look as if they did not."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from tests.kit.moved_joints import FAULT, SWING, TICK, TIME, Floats, Joint, behind, findings, only
from tests.kit.stories import send, tell

from dxlrun.channels.cycle import Torque
from dxlrun.log.log_reader import read_log
from dxlrun.plan.loop_plan import JointPlan
from dxlrun_analysis.finding import Rank
from dxlrun_analysis.report import analyze

WHEEL = """\
name: wheel
buses: {main: {port: sim, protocol: 1.0, baud_rate: 1_000_000, adapter: {kind: direct}}}
loop: {rate: 50}
joints: {w: {bus: main, id: 1, model: AX-12A, reference: 150 deg, direction: 1, continuous: true}}
controllers: {c: {type: joint_group_velocity_controller, joints: [w]}}
"""
FROZEN = np.where(FAULT, behind(SWING)[250], behind(SWING))


ONE_SIDE = np.minimum(behind(SWING), 0.2)
AT_ONE_SPEED = 0.3 - np.abs(0.6 - 0.4 * TIME % 1.2)
LATE = np.where(FAULT, 0.8 * np.sin(3.5 * (TIME - 5.0)), 0.0)
SHORT = np.where((TIME >= 5.0) & (TIME < 6.0), behind(SWING)[250], behind(SWING))
WEAK = np.where(FAULT, 0.3 + 0.05 * SWING, behind(SWING))


def since_fault(position: Floats) -> Floats:
    return np.where(FAULT, position, behind(SWING))


UNFAITHFUL = {
    "frozen": (Joint(position=FROZEN), "stood still, to the tick, at -45.6 deg for 6.0 s"),
    "with its load": (Joint(position=FROZEN), "with 20% of its torque, 21% otherwise; starting at 5.1 s"),
    "jammed": (
        Joint(position=FROZEN, load=np.where(FAULT, 0.9, 0.2)),
        "with 90% of its torque, 20% otherwise",
    ),
    "never moved": (Joint(position=np.zeros(600)), "stood still, to the tick, at 0.0 deg for 12.0 s"),
    "load not read": (Joint(position=np.zeros(600), load=math.nan), "its load was not read"),
    "since its goal left it": (Joint(LATE, np.zeros(600), 0.9), "starting at 5.0 s of the run"),
    "trembles by a tick": (
        Joint(position=FROZEN + np.where(FAULT, TICK * (np.arange(600) % 2), 0.0)),
        "stood still at -45.6 deg",
    ),
    "stops at a place": (
        Joint(position=ONE_SIDE, load=0.2),
        "stops at 11.5 deg each time, and stood still there",
    ),
    "at one speed": (
        Joint(position=AT_ONE_SPEED, load=0.2),
        "38% of the commanded distance, at up to 22.9 deg/s, with 20%",
    ),
    "at half its way": (Joint(position=behind(SWING, 6, 0.5)), "was 23.3 deg from its goal for 3.9 s, and"),
    "off at rest": (Joint(np.full(600, -0.2), np.full(600, -0.6)), "was 22.9 deg from its goal for 12.0 s"),
    "weak": (Joint(position=WEAK, load=np.where(FAULT, 0.05, 0.2)), "with 5% of its torque, 20% otherwise"),
    "gain lost": (
        Joint(position=since_fault(behind(SWING, gain=0.4))),
        "an error of 17.5 deg instead of 1.7 deg",
    ),
    "zero moved": (
        Joint(position=since_fault(behind(SWING) + 0.25)),
        "an error of 14.3 deg instead of 1.7 deg",
    ),
    "late": (Joint(position=since_fault(behind(SWING, 8))), "an error of 9.3 deg instead of 1.7 deg"),
    "far off": (
        Joint(position=since_fault(behind(SWING) + 0.5), load=0.2),
        "an error of 28.6 deg instead of 1.7 deg",
    ),
}
"""Joints that do not do what they are told for a second or more, and words of what is said of them."""


@pytest.mark.parametrize("case", UNFAITHFUL)
def test_joint_that_does_not_follow_is_named_with_its_numbers(case: str) -> None:
    joint, words = UNFAITHFUL[case]
    finding = only(joint)
    stood = "stood still" in finding.sentence
    assert (finding.code, finding.rank) == ("stood_still" if stood else "follows_worse", Rank.SERVO)
    assert words in finding.sentence
    assert finding.remedy == ""  # that of the table


def test_run_with_a_standstill_of_less_than_a_second_is_good() -> None:
    finding = only(Joint(position=SHORT, load=np.where(FAULT, 0.9, 0.2)))
    assert (finding.code, finding.rank) == ("stood_still", Rank.CAUSE)


def test_joints_that_get_worse_together_are_not_accused() -> None:
    worse = Joint(position=since_fault(behind(SWING, gain=0.5)))
    (finding,) = findings(worse, worse, worse)
    assert (finding.code, finding.subject) == ("follows_worse", "main")
    assert "the cause is common" in finding.sentence


@pytest.mark.parametrize(
    ("swing", "hertz", "rank"),
    [(0.04, 10.0, Rank.SERVO), (0.04, 4.0, Rank.REMARK), (0.015, 5.0, Rank.REMARK), (0.005, 5.0, None)],
)
def test_joint_that_swings_around_its_goal_oscillates(swing: float, hertz: float, rank: Rank | None) -> None:
    shaking = np.where(FAULT, swing * np.cos(2 * math.pi * hertz * TIME), 0.0)
    found = findings(Joint(position=behind(SWING) + shaking), Joint(), Joint())
    assert [(one.code, one.subject, one.rank) for one in found] == [("oscillates", "j0", rank)] * bool(rank)
    assert all("around its goal" in one.sentence and "times a second" in one.sentence for one in found)
    assert findings(Joint(way=shaking, position=behind(shaking, 1)), Joint(), Joint()) == []  # as it is told
    both = [Joint(position=behind(SWING) + shaking), Joint(position=behind(SWING) + shaking)]
    assert bool(findings(*both, Joint())) == (rank == Rank.SERVO)


@pytest.mark.parametrize(("away", "told"), [(0.15, True), (0.05, False)])
def test_goals_that_swing_faster_than_the_joint_accuse_its_commands(away: float, told: bool) -> None:
    goals = np.where(FAULT, 0.15 * np.sign(np.cos(2 * math.pi * 8.0 * TIME + 0.1)), 0.0)
    found = findings(Joint(way=goals, position=(1 - away / 0.15) * goals), Joint(), Joint())
    assert [(one.code, one.subject, one.rank) for one in found] == [("oscillates", "j0", Rank.CAUSE)] * told
    assert all("j0 oscillates 8 times a second, like its commands" in one.sentence for one in found)
    assert all("/commands" in one.remedy for one in found)


@pytest.mark.parametrize(("hertz", "shakes"), [(5.0, True), (3.0, False)])
def test_a_joint_that_a_controller_moves_with_an_effort_shakes_around_its_reference(
    hertz: float, shakes: bool
) -> None:
    shaking = np.where(FAULT, 0.06 * np.cos(2 * math.pi * hertz * TIME), 0.0)
    joint = Joint(np.full(600, np.nan), SWING + shaking, effort=SWING, sought=SWING)
    found = findings(joint, Joint(), Joint())
    assert [(one.code, one.subject) for one in found] == [("oscillates", "j0")] * shakes
    assert all("around its goal under effort control" in one.sentence for one in found)
    swung = Joint(np.full(600, np.nan), SWING + shaking, effort=SWING, sought=SWING + shaking)
    assert findings(swung, Joint(), Joint()) == []
    by_hand = Joint(np.full(600, np.nan), SWING + shaking, torque=Torque.RELEASED, sought=SWING)
    assert findings(by_hand, Joint(), Joint()) == []


def test_a_joint_that_is_sent_in_steps_does_not_shake() -> None:
    """A client that sends a goal seven times a second: the joint waits at each."""
    stairs = np.repeat(SWING[::7], 7)[: len(TIME)]
    assert findings(Joint(way=stairs, position=behind(stairs)), Joint(), Joint()) == []


def test_an_error_of_less_than_a_second_or_of_a_degree_is_none() -> None:
    short = np.where((TIME >= 5.0) & (TIME < 5.45), behind(SWING) + 0.4, behind(SWING))
    assert findings(Joint(position=short), Joint(), Joint()) == []
    slow = 0.3 * np.sin(0.5 * TIME)
    assert findings(Joint(way=slow, position=np.where(FAULT, slow + 0.05, slow))) == []


LIFT = np.clip(TIME - 4.0, 0.0, 0.8)
AGAIN = np.clip(np.where(TIME < 6.0, TIME - 2.0, 10.0 - TIME), 0.0, 0.8)
FASTER = 0.8 * np.sin(np.where(FAULT, 5.6 * (TIME - 5.0), 3.0 * (TIME - 5.0)))
TWICE = 0.5 * np.arcsin(np.sin(np.where(FAULT, 4.0, 2.0) * (TIME - 5.0)))
HELD = 0.5 * np.sin(2 * TIME)

INNOCENT = {
    "carries a load all the time": Joint(position=behind(SWING) - 0.12),
    "has a low gain, as its file says": Joint(position=behind(SWING, 6, 0.5), planned={"softness": 3.0}),
    "rests": Joint(way=np.zeros(600), position=np.zeros(600)),
    "is lifted, and gives way where it was not before": Joint(way=LIFT, position=LIFT * 0.85, load=LIFT),
    "carries more later, and gives way by as much": Joint(
        way=AGAIN, position=AGAIN - np.where(TIME > 6, 0.15, 0.02), load=np.where(TIME > 6, 0.6, 0.08)
    ),
    "moves faster": Joint(way=FASTER, position=behind(FASTER, 3), load=0.2),
    "is limp, and turned by hand": Joint(
        position=SWING[::-1], torque=np.where(TIME < 3, Torque.ON, Torque.RELEASED)
    ),
    "was limp, and comes back slowly": Joint(
        way=HELD,
        position=np.where(TIME < 4, HELD, np.where(TIME < 8, 0.9, HELD + 0.5 * np.exp(-(TIME - 8) / 2))),
        torque=np.where((TIME > 4) & (TIME < 8), Torque.OFF, Torque.ON),
    ),
    "is moved faster, and errs by the square of that": Joint(
        way=TWICE,
        position=TWICE - np.where(FAULT, 0.12, 0.03) * np.sign(np.gradient(TWICE)),
        load=0.2,
        velocity=math.nan,
    ),
    "goes as fast as it can": Joint(
        way=0.8 * np.sign(np.sin(TIME)),
        position=np.interp(TIME % 6.28, [0, 1.6, 3.14, 4.74, 6.28], [-0.8, 0.8, 0.8, -0.8, -0.8]),
    ),
}


@pytest.mark.parametrize("case", INNOCENT)
def test_a_joint_that_does_what_it_can_is_not_accused(case: str) -> None:
    assert findings(INNOCENT[case], Joint(), Joint()) == []


def test_thresholds_of_a_linear_joint_are_those_of_its_servo() -> None:
    scale = 0.01
    linear = {"share": scale, "tick": TICK * scale}
    for position, code in (
        (FROZEN, ["stood_still"]),
        (np.where(FAULT, behind(SWING) + 0.25, behind(SWING)), ["follows_worse"]),
        (np.where(FAULT, behind(SWING) + 0.03, behind(SWING)), []),
    ):
        joint = Joint(way=SWING * scale, position=position * scale, planned=linear)
        assert [one.code for one in findings(joint)] == code


QUICK = {"logged": JointPlan("j0", -9.0, 9.0, None, top_speed=5.0)}
SHIFTED = behind(SWING) + 0.4 * np.exp(-np.maximum(TIME - 5.0, 0.0) / 0.1) * FAULT


@pytest.mark.parametrize("sign", [1, -1])
def test_a_position_that_changes_faster_than_the_model_turns_jumped(sign: int) -> None:
    finding = only(Joint(position=behind(SWING) + sign * (SHIFTED - behind(SWING)), planned=QUICK))
    assert (finding.code, finding.rank) == ("position_jumped", Rank.CAUSE)
    assert "a position jump of up to 2" in finding.sentence
    assert "starting at 5.0 s" in finding.sentence


@pytest.mark.parametrize(
    "joint",
    [
        Joint(position=SHIFTED),  # its top speed is not known
        Joint(position=SHIFTED, planned={"logged": JointPlan("j0", -9.0, 9.0, None, top_speed=18.0)}),
        Joint(position=SHIFTED, planned=QUICK, torque=np.where(np.abs(TIME - 5.0) < 0.01, 0, Torque.ON)),
        Joint(position=behind(SWING) + 0.15 * FAULT, planned=QUICK),  # less than 9 deg
        Joint(position=-SWING, planned=QUICK),  # against its goal, but as slowly as it can
    ],
    ids=["unknown", "fast", "by hand", "little", "against"],
)
def test_what_a_joint_may_do_is_no_jump(joint: Joint) -> None:
    assert "position_jumped" not in {finding.code for finding in findings(joint, Joint(), Joint())}


def test_a_wheel_whose_position_wraps_is_not_accused_of_a_slipping_gear(tmp_path: Path) -> None:
    """An AX-12A counts 300 degrees of a turn (e-Manual AX-12A, Present Position (36))."""
    file = tmp_path / "robot.yaml"
    file.write_text(WHEEL)
    log = read_log(tell(file, {20: [send("c", "velocities", 3.0)]}, tmp_path / "run.mcap", seconds=5.0))
    assert np.abs(np.diff(log.cycles["position"][:, 0])).max() > 5.0, "it wrapped"
    assert "position_jumped" not in {one.code for one in analyze(log).verdict.findings}
