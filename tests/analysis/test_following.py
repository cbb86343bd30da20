"""Joints that follow, but otherwise than they did at the same places, and joints that only seem to."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tests.kit.moved_joints import FAULT, TICK, TIME, Floats, Joint, behind, findings

from dxlrun_analysis.finding import Finding, Rank
from dxlrun_analysis.joints.following import followed
from dxlrun_analysis.joints.planned import PlannedJoint
from dxlrun_analysis.joints.trail import STEP_S, Trail

FAST = np.gradient(0.8 * np.sin(3.5 * TIME), TIME)
SWING = 0.8 * np.sin(3.5 * TIME)
PEER = Joint(position=behind(SWING), load=0.05 * np.sign(FAST))


def found(joint: Joint, *others: Joint) -> list[Finding]:
    """Judge a joint beside two that are well, or some others."""
    return findings(joint, *(others or (PEER, PEER)))


def slack(way: Floats, half: float) -> Floats:
    """A position that stands still at each turn until its motor is through the play."""
    at, moved = float(way[0]), []
    for value, now in zip(way, FAULT, strict=True):
        play = half if now else 0.0
        at = min(max(at, value - play), value + play)
        moved.append(at)
    return np.array(moved)


FAR = np.maximum(SWING - 0.2, 0.0)
RUBS = np.where(FAULT, 0.4, 0.05) * np.sign(FAST)
PULLED = behind(SWING) - np.where(FAULT, 0.12 * FAR, 0.0)
WEIGHT = 0.4 + 0.05 * np.sign(FAST)
LOOSE = Joint(position=slack(behind(SWING), 0.05), load=PEER.load)
LOOSER = Joint(position=slack(behind(SWING), 0.07), load=PEER.load)

CHANGED = {
    "play": (LOOSE, "upwards -2.8 deg off instead of -0.1"),
    "each way by itself": (LOOSE, "downwards 2.9 deg off instead of 0.1, with 1% of its torque"),
    "load not read": (
        Joint(position=LOOSE.position, load=math.nan),
        "-2.8 deg off instead of -0.1; downwards",
    ),
    "friction": (
        Joint(position=LOOSE.position, load=RUBS),
        "at rest -2.8 deg off instead of 0.0, with 40%",
    ),
    "later": (Joint(position=np.where(FAULT, behind(SWING, 5), behind(SWING)), load=PEER.load), "-8.3 deg"),
    "pulled": (
        Joint(position=PULLED, load=np.where(FAULT, 0.5 * FAR, 0.0) + PEER.load),
        "24% of its torque instead",
    ),
    "off everywhere": (
        Joint(position=behind(SWING) - np.where(FAULT, 0.06, 0.0), load=PEER.load),
        "-3.4 deg",
    ),
}
"""Joints that follow otherwise than at first, and words of what is said of them."""
LOADED = {
    "friction": RUBS,
    "carries nothing": np.where(FAULT, 0.05 * np.sign(FAST), WEIGHT),
    "carries more": np.where(FAULT, WEIGHT, 0.05 * np.sign(FAST)),
    "carries half": np.where(FAULT, WEIGHT - 0.2, WEIGHT),
}
"""Loads of joints that follow as before, with another torque at the same places."""
INNOCENT = {
    "half a degree": Joint(position=slack(behind(SWING), 0.01), load=PEER.load),
    "a little friction": Joint(position=behind(SWING), load=np.where(FAULT, 0.12, 0.05) * np.sign(FAST)),
    "always late": Joint(position=behind(SWING, 4), load=PEER.load),
    "a little spring": Joint(position=behind(SWING) - np.where(FAULT, 0.05 * FAR, 0.0), load=PEER.load),
    "a weight": Joint(position=behind(SWING) - 0.15 * np.cos(behind(SWING)), load=PEER.load),
    "a hanging weight": Joint(position=behind(SWING) - 0.15 * np.sin(behind(SWING)), load=PEER.load),
    "a weight for one stroke": Joint(
        position=behind(SWING) - np.where((TIME > 9.0) & (TIME < 9.4), 0.12 * FAR, 0.0), load=PEER.load
    ),
    "load at its ends": Joint(position=behind(SWING), load=np.where(FAULT, 0.4 * (SWING / 0.8) ** 8, 0.0)),
    "load as ever": Joint(position=behind(SWING), load=WEIGHT),
}


@pytest.mark.parametrize("case", CHANGED)
def test_joint_that_follows_otherwise_at_the_same_places_is_named_with_its_numbers(case: str) -> None:
    joint, words = CHANGED[case]
    (one,) = found(joint)
    assert (one.code, one.subject, one.rank) == ("follows_worse", "j0", Rank.CAUSE)
    assert "follows differently than before at the same places" in one.sentence
    assert words in one.sentence
    assert "starting at 5." in one.sentence


@pytest.mark.parametrize("case", LOADED)
def test_another_load_at_the_same_places_is_a_remark(case: str) -> None:
    (one,) = found(Joint(position=behind(SWING), load=LOADED[case]))
    assert (one.code, one.subject, one.rank) == ("follows_worse", "j0", Rank.REMARK)
    assert found(Joint(load=LOADED[case]), Joint(load=LOADED[case]), PEER) == []


@pytest.mark.parametrize("case", INNOCENT)
def test_joint_that_follows_as_its_load_lets_it_is_not_named(case: str) -> None:
    assert found(INNOCENT[case]) == []


def test_what_several_joints_show_accuses_none_of_few_and_no_mirror_images() -> None:
    assert found(LOOSE, LOOSE, PEER) == []
    assert [one.subject for one in findings(LOOSE, LOOSER, PEER, PEER, PEER)] == ["j0", "j1"]
    assert findings(LOOSE, LOOSE, LOOSE, PEER, PEER) == []
    assert findings(LOOSE, LOOSER, PEER, PEER) == []  # of few others the worst counts
    names = ("left_knee", "right_knee", "neck", "left_hip", "right_hip")
    assert findings(LOOSE, LOOSER, PEER, PEER, PEER, names=names) == []


def test_a_joint_whose_replies_are_missing_is_not_judged() -> None:
    lossy = behind(SWING) - np.where(FAULT, 0.06, 0.0)
    lossy[::20] = np.nan
    assert found(Joint(position=lossy, load=PEER.load)) == []


def test_a_joint_that_had_no_torque_is_judged_once_it_is_on_its_way_again() -> None:
    way = 0.3 * np.sin(3.5 * TIME)
    back = way + 0.3 * np.exp(-np.maximum(TIME - 7.0, 0.0) / 1.5)
    position = np.where(TIME < 5.0, way, back)
    torque = np.where((TIME > 5.0) & (TIME < 7.0), 0, Joint().torque)
    assert "follows_worse" not in {one.code for one in found(Joint(way, position, 0.05, torque))}


def test_a_long_run_keeps_its_begin_and_its_end() -> None:
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


def test_of_many_cycles_one_is_kept_each_20_ms() -> None:
    trail = Trail(1, 10**9)
    at_ns = 10**9 + np.arange(1000) * 1_000_000
    values = np.zeros((1000, 1))
    for part in (slice(0, 333), slice(333, 1000)):
        trail.add_cycles(at_ns[part], values[part], values[part], values[part])
    assert np.diff(trail.samples().at_s) == pytest.approx(STEP_S)


def test_a_joint_is_compared_with_the_lag_of_its_kind() -> None:
    trail = Trail(3, 0)
    way = np.tile(SWING[:, None], 3)
    position = np.column_stack([behind(SWING, 2), behind(SWING, 2), behind(SWING, 5)])
    trail.add_cycles((TIME * 1e9).astype(np.int64), way, position, np.zeros_like(way))
    planned = [PlannedJoint(f"j{row}", tick=TICK, top_effort=1.0) for row in range(3)]
    assert [one.lag_s for one in followed(planned, trail.samples())] == pytest.approx([0.04] * 3)
    other = [*planned[:2], PlannedJoint("j2", tick=TICK, top_effort=1.0, alike="MX")]
    assert [one.lag_s for one in followed(other, trail.samples())] == pytest.approx([0.04, 0.04, 0.1])
