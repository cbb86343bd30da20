"""Joints that follow within their tolerance, and have play, rub, are pulled or slip, and their innocents."""

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


@pytest.mark.parametrize(
    ("half", "load", "code"),
    [
        (0.05, 0.05, "play"),
        (0.05, math.nan, "lost_motion"),
        (0.05, 0.4, "friction"),
        (0.01, 0.05, ""),  # half a degree: as any servo has
    ],
)
def test_a_joint_that_stands_still_at_each_turn_has_play_or_rubs(half: float, load: float, code: str) -> None:
    takes = np.where(FAULT, load, 0.05) * np.sign(FAST)
    seen = found(Joint(position=slack(behind(SWING), half), load=takes))
    assert [(one.code, one.subject, one.rank) for one in seen] == [(code, "j0", Rank.CAUSE)] * bool(code)
    for one in seen:
        assert "is 2.9 deg behind in both directions (other joints: at most 0.0 deg)" in one.sentence
        assert "stands still at each turn until its goal is 5." in one.sentence
        assert "from 5." in one.sentence
        assert ("(5% before)" in one.sentence) == (code != "lost_motion")


@pytest.mark.parametrize(("load", "told"), [(0.4, True), (0.12, False), (math.nan, False)])
def test_friction_that_a_servo_overcomes_is_told_by_its_load(load: float, told: bool) -> None:
    takes = np.where(FAULT, load, 0.05) * np.sign(FAST)
    seen = found(Joint(position=behind(SWING), load=takes))
    assert [(one.code, one.subject) for one in seen] == [("friction", "j0")] * told
    assert all("takes 40% of its torque in both directions (before: 5%)" in one.sentence for one in seen)
    assert found(Joint(load=takes), Joint(load=takes), PEER) == []


def test_a_joint_that_had_play_from_the_begin_needs_two_of_its_kind() -> None:
    worn = Joint(position=np.array(slack(behind(SWING), 0.0)), load=0.05 * np.sign(FAST))
    worn.position = np.clip(worn.position, *_play(behind(SWING), 0.05))
    assert [one.code for one in found(worn)] == ["play"]
    assert found(worn, Joint(load=PEER.load, planned={"alike": "another"}), PEER) == []


def _play(way: Floats, half: float) -> tuple[Floats, Floats]:
    at, moved = float(way[0]), []
    for value in way:
        at = min(max(at, value - half), value + half)
        moved.append(at)
    return np.array(moved), np.array(moved)


def test_one_that_is_behind_no_more_than_three_times_another_is_not_told() -> None:
    loose = Joint(position=slack(behind(SWING), 0.05), load=PEER.load)
    assert [one.code for one in found(loose)] == ["play"]
    late = Joint(position=behind(SWING, 3), load=PEER.load)
    assert "play" not in {one.code for one in found(loose, late, PEER, PEER)}


def test_what_all_joints_do_is_the_motions_or_the_supplys() -> None:
    loose = Joint(position=slack(behind(SWING), 0.05), load=PEER.load)
    assert found(loose, loose, PEER) == []
    pulled = Joint(position=behind(SWING) - np.where(FAULT, 0.1 * np.maximum(behind(SWING), 0), 0))
    assert found(pulled, pulled, PEER) == []


def test_a_joint_that_follows_later_than_at_first_and_stands_nowhere_is_softer() -> None:
    (one,) = found(Joint(position=np.where(FAULT, behind(SWING, 5), behind(SWING)), load=PEER.load))
    assert (one.code, one.subject) == ("softer_joint", "j0")
    assert "and was not at its first turns" in one.sentence
    assert found(Joint(position=behind(SWING, 3), load=PEER.load)) == []  # a little later, and always was
    assert found(Joint(position=behind(SWING, 4), load=PEER.load)) == []


FAR = np.maximum(SWING - 0.2, 0.0)


@pytest.mark.parametrize("side", [1, -1])
def test_a_joint_that_is_held_back_on_one_side_the_more_the_further_it_goes_is_pulled(side: int) -> None:
    away, load = np.where(FAULT, 0.12 * FAR, 0.0), np.where(FAULT, 0.5 * FAR, 0.0)
    joint = Joint(side * SWING, side * (behind(SWING) - away), side * (load + 0.05 * np.sign(FAST)))
    (one,) = found(joint)
    assert (one.code, one.subject, one.rank) == ("pulled_joint", "j0", Rank.REMARK)
    assert f"the more the further it goes {'beyond' if side > 0 else 'below'}" in one.sentence
    assert "of its torque instead of" in one.sentence


WEIGHTS = {
    "a little spring": behind(SWING) - np.where(FAULT, 0.05 * FAR, 0.0),
    "a weight": behind(SWING) - 0.15 * np.cos(behind(SWING)),
    "a hanging weight": behind(SWING) - 0.15 * np.sin(behind(SWING)),
    "a weight for one stroke": behind(SWING) - np.where((TIME > 9.0) & (TIME < 9.4), 0.12 * FAR, 0.0),
}


@pytest.mark.parametrize("case", WEIGHTS)
def test_what_pulls_but_little_or_by_the_sine_of_the_angle_is_not_told(case: str) -> None:
    assert found(Joint(position=WEIGHTS[case], load=PEER.load)) == []


def test_two_joints_that_are_not_well_are_both_told_unless_they_are_mirror_images() -> None:
    loose = Joint(position=slack(behind(SWING), 0.05), load=PEER.load)
    rubs = Joint(position=slack(behind(SWING), 0.07), load=np.where(FAULT, 0.4, 0.05) * np.sign(FAST))
    seen = findings(loose, rubs, PEER, PEER, PEER)
    assert [(one.code, one.subject) for one in seen] == [("play", "j0"), ("friction", "j1")]
    assert findings(loose, loose, loose, PEER, PEER) == []
    looser = Joint(position=slack(behind(SWING), 0.07), load=PEER.load)
    assert len(findings(loose, looser, PEER, PEER, PEER)) == 2
    assert findings(loose, looser, PEER, PEER) == []  # of few others the worst counts
    names = ("left_knee", "right_knee", "neck", "left_hip", "right_hip")
    assert findings(loose, looser, PEER, PEER, PEER, names=names) == []


def test_a_joint_that_is_off_everywhere_is_told_as_it_was_seen() -> None:
    (one,) = found(Joint(position=behind(SWING) - np.where(FAULT, 0.06, 0.0), load=PEER.load))
    assert (one.code, one.rank) == ("off_its_way", Rank.REMARK)
    assert (
        "is off by up to 3.5 deg more than before at the same places (other joints: at most" in one.sentence
    )
    assert "instead of" not in one.sentence


WEIGHT = 0.4 + 0.05 * np.sign(FAST)


@pytest.mark.parametrize(
    ("load", "code"),
    [
        (np.where(FAULT, 0.05 * np.sign(FAST), WEIGHT), "carries_nothing"),
        (np.where(FAULT, WEIGHT, 0.05 * np.sign(FAST)), "off_its_way"),
        (np.where(FAULT, WEIGHT - 0.2, WEIGHT), "off_its_way"),
        (np.where(FAULT, 0.05, 0.0) + 0.05 * np.sign(FAST), ""),
        (WEIGHT, ""),
        (np.where(FAULT, 0.4 * (SWING / 0.8) ** 8, 0.0), ""),  # where its speed changes
        (0.4 * np.sin(7.9 * TIME), ""),  # by the time, not by the place
    ],
    ids=["nothing", "more", "half", "a little", "always", "at its ends", "changing"],
)
def test_a_load_that_is_another_one_at_the_same_places_is_told(load: Floats, code: str) -> None:
    seen = found(Joint(position=behind(SWING), load=load))
    assert [(one.code, one.rank) for one in seen] == [(code, Rank.REMARK)] * bool(code)
    assert all("of its torque at places where it took" in one.sentence for one in seen)


@pytest.mark.parametrize(("times", "size", "told"), [(6, 0.05, True), (3, 0.05, False), (6, 0.015, False)])
def test_a_joint_that_is_thrown_off_its_way_again_and_again_slips(
    times: int, size: float, told: bool
) -> None:
    slow = 0.4 * np.sin(0.9 * TIME)
    begins = 5.0 + 0.9 * np.arange(times)
    thrown = size * sum(((at <= TIME) & (at + 0.1 > TIME) for at in begins), np.zeros(len(TIME)))
    peer = Joint(slow, behind(slow), 0.05)
    seen = found(Joint(slow, behind(slow) + thrown, 0.05), peer, peer)
    assert [(one.code, one.rank) for one in seen] == [("jerked_joint", Rank.REMARK)] * told
    assert all("is thrown off its way 6 times while its goals are even" in one.sentence for one in seen)
    shaken = Joint(slow, behind(slow) + thrown / 2, 0.05)
    assert found(Joint(slow, behind(slow) + thrown, 0.05), shaken, peer) == []  # the ground, or a blow


def test_a_joint_whose_replies_are_missing_is_not_judged() -> None:
    lossy = behind(SWING) - np.where(FAULT, 0.06, 0.0)
    lossy[::20] = np.nan
    assert found(Joint(position=lossy, load=PEER.load)) == []


def test_a_joint_that_had_no_torque_is_judged_once_it_is_on_its_way_again() -> None:
    way = 0.3 * np.sin(3.5 * TIME)
    back = way + 0.3 * np.exp(-np.maximum(TIME - 7.0, 0.0) / 1.5)
    position = np.where(TIME < 5.0, way, back)
    torque = np.where((TIME > 5.0) & (TIME < 7.0), 0, Joint().torque)
    assert "off_its_way" not in {one.code for one in found(Joint(way, position, 0.05, torque))}


def test_a_long_run_keeps_its_begin_and_its_end() -> None:
    trail, cycles = Trail(1, 0), 30_000
    at_ns = (np.arange(cycles) * 0.03e9).astype(np.int64)
    column = np.arange(cycles, dtype=np.float64)[:, None]
    for begin in range(0, cycles, 999):
        part = slice(begin, begin + 999)
        trail.take(at_ns[part], column[part], column[part], column[part])
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
        trail.take(at_ns[part], values[part], values[part], values[part])
    assert np.diff(trail.samples().at_s) == pytest.approx(STEP_S)


@pytest.mark.parametrize("hertz", [50, 25])
def test_a_joint_is_thrown_off_within_80_ms_at_any_rate_of_the_loop(hertz: int) -> None:
    at_s = np.arange(0.0, 12.0, 1 / hertz)
    way = 0.4 * np.sin(0.9 * at_s)[:, None]
    slow = 0.2 * np.clip((at_s - 6.0) / 0.4, 0.0, 1.0)[:, None]  # by 2.3 deg in 80 ms, 3.4 deg in 120 ms
    trail = Trail(1, 0)
    trail.take((at_s * 1e9).astype(np.int64), way, way + slow, np.zeros_like(way))
    (one,) = followed([PlannedJoint("j0", tick=TICK, top_effort=1.0)], trail.samples())
    assert np.nanmax(one.jerks()[at_s[: len(one.jerks())] > 1.0]) == pytest.approx(0.04, abs=0.002)


def test_a_joint_is_compared_with_the_lag_of_its_kind() -> None:
    trail = Trail(3, 0)
    way = np.tile(SWING[:, None], 3)
    position = np.column_stack([behind(SWING, 2), behind(SWING, 2), behind(SWING, 5)])
    trail.take((TIME * 1e9).astype(np.int64), way, position, np.zeros_like(way))
    planned = [PlannedJoint(f"j{row}", tick=TICK, top_effort=1.0) for row in range(3)]
    assert [one.lag_s for one in followed(planned, trail.samples())] == pytest.approx([0.04] * 3)
    other = [*planned[:2], PlannedJoint("j2", tick=TICK, top_effort=1.0, alike="MX")]
    assert [one.lag_s for one in followed(other, trail.samples())] == pytest.approx([0.04, 0.04, 0.1])
