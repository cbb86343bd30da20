"""Joints that do not do what they are told or follow otherwise than before, and joints that only look so."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from dxlrun.channels.cycle import Torque
from dxlrun.plan.loop_plan import JointPlan
from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.joints.following import followed
from dxlrun_analysis.joints.joint_columns import JointColumns
from dxlrun_analysis.joints.movement import Movement
from dxlrun_analysis.joints.planned import PlannedJoint
from dxlrun_analysis.joints.trail import STEP_S, Trail

Floats = npt.NDArray[np.float64]
DT = 0.02
TIME = np.arange(600) * DT  # 12 s
FAULT = TIME >= 5.0
SWING = 0.8 * np.sin(3.5 * TIME)
LOAD = 0.2 + 0.1 * np.sin(7 * TIME)
TICK = 0.005
FIELDS = ("position", "velocity", "effort", "goal_effort", "goal_position", "reference")


def behind(way: Floats, cycles: int = 2, gain: float = 1.0) -> Floats:
    """A joint that follows its way some cycles late, and in part."""
    return gain * np.concatenate([np.full(cycles, way[0]), way[:-cycles]])


def since_fault(position: Floats | float, before: Floats | float = behind(SWING)) -> Floats:  # noqa: B008  a constant
    """Something from 5 s on, and something else before; without one, a joint that follows."""
    return np.where(FAULT, position, before)


@dataclass
class Joint:
    """Goals of a joint, and its motion."""

    way: Floats = field(default_factory=lambda: SWING)
    position: Floats = field(default_factory=lambda: behind(SWING))
    load: Floats | float = field(default_factory=lambda: LOAD)
    torque: Any = Torque.ON
    velocity: float = 1.0  # NaN: not read
    planned: dict[str, Any] = field(default_factory=dict)
    effort: Floats | float = math.nan  # what a controller moves it with
    sought: Floats | float = math.nan  # where that controller is to move it


def findings(*joints: Joint, names: Sequence[str] = ()) -> list[Finding]:
    """Judge joints; all others beside them follow well."""
    count = len(joints)
    kind = [("read_ns", np.int64), *((name, np.float64, count) for name in FIELDS)]
    kind += [("age_ns", np.int64, count), ("torque", np.uint8, count), ("valid", np.bool_, count)]
    cycles = np.zeros(len(TIME), kind)
    cycles["read_ns"], cycles["valid"] = 10**9 + (TIME * 1e9).astype(np.int64), True
    planned = []
    for row, joint in enumerate(joints):
        tick = joint.planned.get("tick", TICK)
        position = np.round(joint.position / tick) * tick
        velocity = joint.velocity * np.gradient(joint.position, DT)
        values = (position, velocity, joint.load, joint.effort, joint.way, joint.sought)
        for name, value in zip(FIELDS, values, strict=True):
            cycles[name][:, row] = value
        cycles["torque"][:, row] = joint.torque
        facts = {"bus": "main", "servos": f"servo {row}", "top_effort": 1.0, "tick": TICK, **joint.planned}
        planned.append(PlannedJoint(names[row] if names else f"j{row}", **facts))
    references = [f"pid/{joint.name}/position" for joint in planned]
    movement = Movement(planned, int(cycles["read_ns"][0]), references)
    ways = np.array([joint.way for joint in joints])
    for begin in range(0, len(TIME), 150):  # slice by slice, two cycles of the one before with each
        known = min(begin, 2)
        part = slice(begin - known, begin + 150)
        movement.add_cycles(JointColumns(cycles[part]), ways[:, part], known)
    return list(movement.findings())


ZERO = np.zeros(600)
WELL = Joint(), Joint()
"""Two joints beside the one that is judged"""


def told(*joints: Joint) -> list[tuple[str, str, Rank]]:
    """Return codes, subjects and ranks of what is found of joints, or of one beside two that are well."""
    return [
        (one.code, one.subject, one.rank) for one in findings(*joints, *(WELL if len(joints) == 1 else ()))
    ]


# Joints that do not do what they are told for a second or more

STILL = behind(SWING)[250]
FROZEN = since_fault(STILL)
JAMMED = since_fault(0.9, 0.2)
LATE = since_fault(0.8 * np.sin(3.5 * (TIME - 5.0)), 0.0)
AT_ONE_SPEED = 0.3 - np.abs(0.6 - 0.4 * TIME % 1.2)
TREMBLING = FROZEN + since_fault(TICK * (np.arange(600) % 2), 0.0)
WEAK = since_fault(0.3 + 0.05 * SWING)

UNFAITHFUL = {
    "frozen": (Joint(position=FROZEN), "stood still, to the tick, at -45.6 deg for 6.0 s"),
    "with its load": (Joint(position=FROZEN), "with 20% of its torque, 21% otherwise; starting at 5.1 s"),
    "jammed": (Joint(position=FROZEN, load=JAMMED), "with 90% of its torque, 20% otherwise"),
    "never moved": (Joint(position=ZERO), "stood still, to the tick, at 0.0 deg for 12.0 s"),
    "load not read": (Joint(position=ZERO, load=math.nan), "its load was not read"),
    "since its goal left it": (Joint(LATE, ZERO, 0.9), "starting at 5.0 s of the run"),
    "trembles by a tick": (Joint(position=TREMBLING), "stood still at -45.6 deg"),
    "stops at a place": (
        Joint(position=np.minimum(behind(SWING), 0.2), load=0.2),
        "stops at 11.5 deg each time, and stood still there",
    ),
    "at one speed": (
        Joint(position=AT_ONE_SPEED, load=0.2),
        "38% of the commanded distance, at up to 22.9 deg/s, with 20%",
    ),
    "at half its way": (Joint(position=behind(SWING, 6, 0.5)), "was 23.3 deg from its goal for 3.9 s, and"),
    "off at rest": (Joint(ZERO - 0.2, ZERO - 0.6), "was 22.9 deg from its goal for 12.0 s"),
    "weak": (Joint(position=WEAK, load=since_fault(0.05, 0.2)), "with 5% of its torque, 20% otherwise"),
    "gain lost": (Joint(position=since_fault(behind(SWING, gain=0.4))), "17.5 deg instead of 1.7 deg"),
    "zero moved": (Joint(position=since_fault(behind(SWING) + 0.25)), "14.3 deg instead of 1.7 deg"),
    "late": (Joint(position=since_fault(behind(SWING, 8))), "an error of 9.3 deg instead of 1.7 deg"),
    "far off": (Joint(position=since_fault(behind(SWING) + 0.5), load=0.2), "28.6 deg instead of 1.7 deg"),
}


@pytest.mark.parametrize("case", UNFAITHFUL)
def test_joint_that_does_not_follow_is_named_with_its_numbers(case):
    joint, words = UNFAITHFUL[case]
    (finding,) = findings(joint, *WELL)
    code = "stood_still" if "stood still" in finding.sentence else "follows_worse"
    assert (finding.code, finding.subject, finding.rank, finding.remedy) == (code, "j0", Rank.SERVO, "")
    assert words in finding.sentence


def test_short_and_common_errors():
    short = np.where((TIME >= 5.0) & (TIME < 6.0), STILL, behind(SWING))
    assert told(Joint(position=short, load=JAMMED)) == [("stood_still", "j0", Rank.CAUSE)]
    worse = Joint(position=since_fault(behind(SWING, gain=0.5)))
    (finding,) = findings(worse, worse, worse)
    assert (finding.code, finding.subject) == ("follows_worse", "main")
    assert "the cause is common" in finding.sentence
    shorter = np.where((TIME >= 5.0) & (TIME < 5.45), behind(SWING) + 0.4, behind(SWING))
    assert told(Joint(position=shorter)) == []
    slow = 0.3 * np.sin(0.5 * TIME)
    assert findings(Joint(way=slow, position=since_fault(slow + 0.05, slow))) == []


def shaking(swing: float, hertz: float) -> Floats:
    return since_fault(swing * np.cos(2 * math.pi * hertz * TIME), 0.0)


@pytest.mark.parametrize(
    ("swing", "hertz", "rank"),
    [(0.04, 10.0, Rank.SERVO), (0.04, 4.0, Rank.REMARK), (0.015, 5.0, Rank.REMARK), (0.005, 5.0, None)],
)
def test_joint_that_swings_around_its_goal_oscillates(swing, hertz, rank):
    shakes = shaking(swing, hertz)
    joint = Joint(position=behind(SWING) + shakes)
    assert told(joint) == [("oscillates", "j0", rank)] * bool(rank)
    lossy = np.where(np.arange(600) % 3 == 2, math.nan, joint.position)
    assert told(Joint(position=lossy)) == []  # no swing was read as a whole
    for one in findings(joint, *WELL):
        assert "around its goal" in one.sentence
        assert "times a second" in one.sentence
    assert told(Joint(way=shakes, position=behind(shakes, 1))) == []  # as it is told
    assert bool(findings(joint, joint, Joint())) == (rank == Rank.SERVO)


@pytest.mark.parametrize(("away", "named"), [(0.15, True), (0.05, False)])
def test_goals_that_swing_faster_than_the_joint_accuse_its_commands(away, named):
    goals = since_fault(0.15 * np.sign(np.cos(2 * math.pi * 8.0 * TIME + 0.1)), 0.0)
    found = findings(Joint(way=goals, position=(1 - away / 0.15) * goals), *WELL)
    assert [(one.code, one.subject, one.rank) for one in found] == [("oscillates", "j0", Rank.CAUSE)] * named
    assert all("j0 oscillates 8 times a second, like its commands" in one.sentence for one in found)
    assert all("/commands" in one.remedy for one in found)


@pytest.mark.parametrize(("hertz", "shakes"), [(5.0, True), (3.0, False)])
def test_joint_that_a_controller_moves_with_an_effort_shakes_around_its_reference(hertz, shakes):
    position, nowhere = SWING + shaking(0.06, hertz), ZERO + math.nan
    found = findings(Joint(nowhere, position, effort=SWING, sought=SWING), *WELL)
    assert [(one.code, one.subject) for one in found] == [("oscillates", "j0")] * shakes
    assert all("around its goal under effort control" in one.sentence for one in found)
    assert told(Joint(nowhere, position, effort=SWING, sought=position)) == []
    assert told(Joint(nowhere, position, torque=Torque.RELEASED, sought=SWING)) == []  # by hand


QUICK = {"logged": JointPlan("j0", -9.0, 9.0, None, top_speed=5.0)}
SHIFT = 0.4 * np.exp(-np.maximum(TIME - 5.0, 0.0) / 0.1) * FAULT
SHIFTED = behind(SWING) + SHIFT


@pytest.mark.parametrize("sign", [1, -1])
def test_position_that_changes_faster_than_the_model_turns_jumped(sign):
    (finding,) = findings(Joint(position=behind(SWING) + sign * SHIFT, planned=QUICK), *WELL)
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
def test_what_a_joint_may_do_is_no_jump(joint):
    assert "position_jumped" not in {code for code, *_ in told(joint)}


# Joints that do what they can

LIFT = np.clip(TIME - 4.0, 0.0, 0.8)
AGAIN = np.clip(np.where(TIME < 6.0, TIME - 2.0, 10.0 - TIME), 0.0, 0.8)
MORE = np.where(TIME > 6, 1.0, 0.0)
FASTER = 0.8 * np.sin(since_fault(5.6, 3.0) * (TIME - 5.0))
TWICE = 0.5 * np.arcsin(np.sin(since_fault(4.0, 2.0) * (TIME - 5.0)))
SQUARE = TWICE - since_fault(0.12, 0.03) * np.sign(np.gradient(TWICE))
HELD = 0.5 * np.sin(2 * TIME)
LIMP = (TIME > 4) & (TIME < 8)
BACK = np.where(TIME < 4, HELD, np.where(TIME < 8, 0.9, HELD + 0.5 * np.exp(-(TIME - 8) / 2)))
CORNERS = np.interp(TIME % 6.28, [0, 1.6, 3.14, 4.74, 6.28], [-0.8, 0.8, 0.8, -0.8, -0.8])
STAIRS = np.repeat(SWING[::7], 7)[: len(TIME)]

CAPABLE = {
    "carries a load all the time": Joint(position=behind(SWING) - 0.12),
    "has a low gain, as its file says": Joint(position=behind(SWING, 6, 0.5), planned={"softness": 3.0}),
    "rests": Joint(way=ZERO, position=ZERO),
    "is within its tolerance": Joint(
        ZERO - 0.2, ZERO - 0.6, planned={"logged": JointPlan("j0", -9.0, 9.0, None, tolerance=0.45)}
    ),
    "is lifted, and gives way where it was not before": Joint(LIFT, LIFT * 0.85, LIFT),
    "carries more later, and gives way by as much": Joint(
        AGAIN, AGAIN - 0.02 - 0.13 * MORE, 0.08 + 0.52 * MORE
    ),
    "moves faster": Joint(FASTER, behind(FASTER, 3), 0.2),
    "is turned by hand": Joint(position=SWING[::-1], torque=np.where(TIME < 3, Torque.ON, Torque.RELEASED)),
    "was limp, and comes back slowly": Joint(HELD, BACK, torque=np.where(LIMP, Torque.OFF, Torque.ON)),
    "is moved faster, and errs by the square of that": Joint(TWICE, SQUARE, 0.2, velocity=math.nan),
    "goes as fast as it can": Joint(0.8 * np.sign(np.sin(TIME)), CORNERS),
    "waits at each goal that it is sent": Joint(STAIRS, behind(STAIRS)),
}


@pytest.mark.parametrize("case", CAPABLE)
def test_joint_that_does_what_it_can_is_not_accused(case):
    assert told(CAPABLE[case]) == []


@pytest.mark.parametrize(
    ("position", "codes"),
    [
        (FROZEN, ["stood_still"]),
        (since_fault(behind(SWING) + 0.25), ["follows_worse"]),
        (since_fault(behind(SWING) + 0.03), []),
    ],
)
def test_thresholds_of_a_linear_joint_are_those_of_its_servo(position, codes):
    linear = {"share": 0.01, "tick": TICK * 0.01}
    joint = Joint(way=SWING * 0.01, position=position * 0.01, planned=linear)
    assert [one.code for one in findings(joint)] == codes


# Joints that follow, but otherwise than they did at the same places

WAYS = np.sign(np.gradient(SWING, TIME))
FRICTION = 0.05 * WAYS
PEER = Joint(position=behind(SWING), load=FRICTION)


def beside_peers(position: Floats, load: Any = FRICTION) -> list[Any]:
    return findings(Joint(position=position, load=load), PEER, PEER)


def slack(half: float) -> Floats:
    """A position that stands still at each turn until its motor is through the play."""
    way, moved = behind(SWING), []
    at = float(way[0])
    for value, now in zip(way, FAULT, strict=True):
        play = half if now else 0.0
        at = min(max(at, value - play), value + play)
        moved.append(at)
    return np.array(moved)


FAR = np.maximum(SWING - 0.2, 0.0)
RUBS = since_fault(0.4, 0.05) * WAYS
WEIGHT = 0.4 + FRICTION
LOOSE = slack(0.05)
PULLED = behind(SWING) - since_fault(0.12 * FAR, 0.0)
ONE_STROKE = np.where((TIME > 9.0) & (TIME < 9.4), 0.12 * FAR, 0.0)

CHANGED = {
    "play": (LOOSE, FRICTION, "upwards -2.8 deg off instead of -0.1"),
    "each way by itself": (LOOSE, FRICTION, "downwards 2.9 deg off instead of 0.1, with 1% of its torque"),
    "load not read": (LOOSE, math.nan, "-2.8 deg off instead of -0.1; downwards"),
    "friction": (LOOSE, RUBS, "at rest -2.8 deg off instead of 0.0, with 40%"),
    "later": (since_fault(behind(SWING, 5)), FRICTION, "-8.3 deg"),
    "pulled": (PULLED, since_fault(0.5 * FAR, 0.0) + FRICTION, "24% of its torque instead"),
    "off everywhere": (behind(SWING) - 0.06 * FAULT, FRICTION, "-3.4 deg"),
}
"""Joints that follow otherwise than at first, and words of what is said of them."""
LOADED = {
    "friction": RUBS,
    "carries nothing": since_fault(FRICTION, WEIGHT),
    "carries more": since_fault(WEIGHT, FRICTION),
    "carries half": since_fault(WEIGHT - 0.2, WEIGHT),
}
"""Loads of joints that follow as before, with another torque at the same places."""
SAME = {
    "half a degree": (slack(0.01), FRICTION),
    "a little friction": (behind(SWING), since_fault(0.12, 0.05) * WAYS),
    "always late": (behind(SWING, 4), FRICTION),
    "a little spring": (behind(SWING) - since_fault(0.05 * FAR, 0.0), FRICTION),
    "a weight": (behind(SWING) - 0.15 * np.cos(behind(SWING)), FRICTION),
    "a hanging weight": (behind(SWING) - 0.15 * np.sin(behind(SWING)), FRICTION),
    "a weight for one stroke": (behind(SWING) - ONE_STROKE, FRICTION),
    "load at its ends": (behind(SWING), since_fault(0.4 * (SWING / 0.8) ** 8, 0.0)),
    "load as ever": (behind(SWING), WEIGHT),
    "replies are missing": (np.where(np.arange(600) % 20, behind(SWING) - 0.06 * FAULT, math.nan), FRICTION),
}


@pytest.mark.parametrize("case", CHANGED)
def test_joint_that_follows_otherwise_at_the_same_places_is_named_with_its_numbers(case):
    position, load, words = CHANGED[case]
    (one,) = beside_peers(position, load)
    assert (one.code, one.subject, one.rank) == ("follows_worse", "j0", Rank.CAUSE)
    assert "follows differently than before at the same places" in one.sentence
    assert words in one.sentence
    assert "starting at 5." in one.sentence


@pytest.mark.parametrize("case", LOADED)
def test_another_load_at_the_same_places_is_a_remark(case):
    (one,) = beside_peers(behind(SWING), LOADED[case])
    assert (one.code, one.subject, one.rank) == ("follows_worse", "j0", Rank.REMARK)
    assert findings(Joint(load=LOADED[case]), Joint(load=LOADED[case]), PEER) == []


@pytest.mark.parametrize("case", SAME)
def test_joint_that_follows_as_its_load_lets_it_is_not_named(case):
    assert beside_peers(*SAME[case]) == []


def test_what_several_joints_show_accuses_none_of_few_and_no_mirror_images():
    loose, looser = (Joint(position=slack(half), load=FRICTION) for half in (0.05, 0.07))
    assert findings(loose, loose, PEER) == []
    assert [one.subject for one in findings(loose, looser, PEER, PEER, PEER)] == ["j0", "j1"]
    assert findings(loose, loose, loose, PEER, PEER) == []
    assert findings(loose, looser, PEER, PEER) == []  # of few others the worst counts
    names = ("left_knee", "right_knee", "neck", "left_hip", "right_hip")
    assert findings(loose, looser, PEER, PEER, PEER, names=names) == []


def test_joint_that_had_no_torque_is_judged_once_it_is_on_its_way_again():
    way = 0.3 * np.sin(3.5 * TIME)
    position = np.where(TIME < 5.0, way, way + 0.3 * np.exp(-np.maximum(TIME - 7.0, 0.0) / 1.5))
    torque = np.where((TIME > 5.0) & (TIME < 7.0), 0, Torque.ON)
    found = findings(Joint(way, position, 0.05, torque), PEER, PEER)
    assert "follows_worse" not in {one.code for one in found}


# What is kept of a run


def test_long_run_keeps_its_begin_and_its_end():
    trail, cycles = Trail(1, 0), 30_000
    at_ns = (np.arange(cycles) * 0.03e9).astype(np.int64)
    column = np.arange(cycles, dtype=np.float64)[:, None]
    for begin in range(0, cycles, 999):
        part = slice(begin, begin + 999)
        trail.add_cycles(at_ns[part], column[part], column[part], column[part])
    kept = trail.samples()
    assert len(kept.at_s) == 8_192
    assert kept.way[:4096, 0].tolist() == list(range(4096))
    assert np.isnan(kept.way[4096, 0])
    assert kept.way[4097:, 0].tolist() == list(range(cycles - 4095, cycles))


def test_of_many_cycles_one_is_kept_each_20_ms():
    trail, values = Trail(1, 10**9), np.zeros((1000, 1))
    at_ns = 10**9 + np.arange(1000) * 1_000_000
    for part in (slice(0, 333), slice(333, 1000)):
        trail.add_cycles(at_ns[part], values[part], values[part], values[part])
    assert np.diff(trail.samples().at_s) == pytest.approx(STEP_S)


def test_joint_is_compared_with_the_lag_of_its_kind():
    trail, way = Trail(3, 0), np.tile(SWING[:, None], 3)
    position = np.column_stack([behind(SWING, cycles) for cycles in (2, 2, 5)])
    trail.add_cycles((TIME * 1e9).astype(np.int64), way, position, np.zeros_like(way))
    planned = [PlannedJoint(f"j{row}", tick=TICK, top_effort=1.0) for row in range(3)]
    assert [one.lag_s for one in followed(planned, trail.samples())] == pytest.approx([0.04] * 3)
    other = [*planned[:2], PlannedJoint("j2", tick=TICK, top_effort=1.0, alike="MX")]
    assert [one.lag_s for one in followed(other, trail.samples())] == pytest.approx([0.04, 0.04, 0.1])
