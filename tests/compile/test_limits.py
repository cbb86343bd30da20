# ruff: noqa: E501 (a mistake and its sentence are read best side by side)
"""Limits of joints by unlike bounds: each side, each sign, and what lies on the bound itself."""

from __future__ import annotations

import math

import pytest

from dxlrun.compile.joints.limits import (
    Interval,
    beyond_limits,
    check_samples,
    limits_of,
)
from dxlrun.compile.motion_samples import MotionSample, SampledTarget
from dxlrun.compile.problems import Problems
from dxlrun.contract.controller import SpeedPeak
from dxlrun.errors import Mark
from dxlrun.plan.loop_plan import JointPlan
from dxlrun_controllers.group import EffortsCommand, PositionsCommand, VelocitiesCommand
from dxlwire.joint_unit import LINEAR

MARK = Mark("m.yaml", 3, 5)
ARM = JointPlan("arm", -1.0, 0.5, 2.0, 0.5, top_speed=8.0, top_effort=3.0)
SLIDE = JointPlan("slide", -0.02, 0.05, None, top_speed=0.1, top_effort=3.0, unit=LINEAR)
SOME_S = 1_000_000_000


@pytest.mark.parametrize(
    ("lower", "upper", "inside"),
    [
        (-1.0, 0.5, True),
        (-1.001, 0.5, False),
        (-1.0, 0.501, False),
        (-1.0 - 5e-7, 0.5 + 5e-7, True),
        (0, 0, True),
    ],
)
def test_an_interval_contains_what_is_inside_on_both_sides(lower: float, upper: float, inside: bool) -> None:
    assert limits_of(ARM).contains(Interval(lower, upper)) is inside


def test_intervals_meet_in_the_tighter_bound_of_each_side() -> None:
    for one, other in ((Interval(-3, 1), Interval(-2, 4)), (Interval(-2, 4), Interval(-3, 1))):
        assert one.meet(other) == Interval(-2, 1)
    assert Interval(-3, -1).meet(Interval(-1, 2)) is None  # a point
    assert Interval(-3, -2).meet(Interval(-1, 2)) is None
    assert Interval(-3, 1).scaled(2.0, LINEAR) == Interval(-6, 2, LINEAR)
    assert (limits_of(ARM), limits_of(SLIDE)) == (Interval(-1, 0.5), Interval(-0.02, 0.05, LINEAR))


def test_positions_are_written_with_their_signs() -> None:
    assert (str(limits_of(ARM)), str(limits_of(SLIDE))) == ("-57.3..+28.65 deg", "-20..+50 mm")


def samples(*rows: tuple[float, float | None, float | None]) -> list[MotionSample]:
    """Return samples of `arm`: time s, position, velocity."""
    return [
        MotionSample(
            round(t * SOME_S),
            {"arm": SampledTarget(position, velocity, None, Mark("m.yaml", 3 + index))},
            MARK,
        )
        for index, (t, position, velocity) in enumerate(rows)
    ]


@pytest.mark.parametrize(
    ("positions", "told"),
    [
        ((-1.0, 0.5), None),
        ((-1.0 - 5e-7, 0.5 + 5e-7), None),
        ((0.0, -1.01), "arm is sent to -57.87 deg at 3.000 s, outside its limits -57.3..+28.65 deg"),
        ((0.51, 0.0), "arm is sent to 29.22 deg at 2.000 s, outside its limits -57.3..+28.65 deg"),
        (
            (-1.1, 0.7),
            "arm is sent to 40.11 deg at 3.000 s, outside its limits -57.3..+28.65 deg",
        ),  # the worst
        ((-1.3, 0.7), "arm is sent to -74.48 deg at 2.000 s, outside its limits -57.3..+28.65 deg"),
    ],
)
def test_the_worst_target_beyond_either_limit_is_told_once(
    positions: tuple[float, ...], told: str | None
) -> None:
    problems = Problems()
    listed = samples(*((index, position, None) for index, position in enumerate(positions)))
    check_samples(listed, 2 * SOME_S, {"arm": ARM}, problems)
    assert [one.what for one in problems.warnings] == ([told] if told else [])
    if told:
        worst = max(range(2), key=lambda index: max(-1.0 - positions[index], positions[index] - 0.5))
        assert problems.warnings[0].mark.line == 3 + worst


def peak(speed: float, time: float) -> SpeedPeak:
    return SpeedPeak("arm", speed, time, "from point 1 to 2")


@pytest.mark.parametrize(
    ("rows", "peaks", "told"),
    [
        (((0, 0.0, 2.0), (1, 0.0, -2.0)), [peak(-2.0, 0.5)], []),
        (((0, 0.0, -2.1),), [], ["warning: arm is commanded to 2.1 rad/s at 2.000 s, more than 2 rad/s, its velocity limit"]),
        (((0, 0.0, 2.1), (1, 0.0, -7.9)), [], ["warning: arm is commanded to 7.9 rad/s at 3.000 s"]),
        (((0, 0.0, -8.1),), [], ["arm is commanded to 8.1 rad/s at 2.000 s, more than 8 rad/s, the top speed of its servo"]),
        (((0, -0.5, None), (0.25, 0.5, None)), [], []),  # nothing moves between the two
        (((0, -0.5, None), (0.25, 0.5, None)), [peak(4.0, 0.25)], ["warning: arm is commanded to 4 rad/s at 2.250 s"]),
        (((0, 0.5, 0.0), (0.25, -0.5, 0.0)), [peak(-6.0, 0.125)], ["warning: arm is commanded to 6 rad/s at 2.125 s"]),
        (((0, 0.5, 0.0), (0.1, -0.5, 0.0)), [peak(-15.0, 0.05)], ["arm is commanded to 15 rad/s at 2.050 s"]),
        (((0, 0.5, 3.0), (0.1, 0.5, 0.0)), [peak(-2.5, 0.05)], ["warning: arm is commanded to 3 rad/s at 2.000 s"]),
    ],
)  # fmt: skip
def test_speeds_of_either_sign_are_compared(
    rows: tuple[tuple[float, float | None, float | None], ...], peaks: list[SpeedPeak], told: list[str]
) -> None:
    problems = Problems()
    check_samples(samples(*rows), 2 * SOME_S, {"arm": ARM}, problems, peaks)
    found = [str(one).split(": ", 1)[1] for one in (*problems.errors, *problems.warnings)]
    assert len(found) == len(told)
    assert all(one.startswith(start) for one, start in zip(found, told, strict=True)), found


def test_a_peak_is_reported_at_the_point_that_its_way_leads_to() -> None:
    problems = Problems()
    listed = samples((0, 0.0, 0.0), (1, 0.4, 0.0), (2, -0.4, 0.0))
    check_samples(listed, 0, {"arm": ARM}, problems, [peak(-2.4, 1.5)])
    (warning,) = problems.warnings
    assert warning.mark.line == 5
    assert "allow more time, 1.2 times as long, or raise the limit" in warning.fix


@pytest.mark.parametrize(
    ("value", "beyond"),
    [(-1.0, False), (0.5, False), (-1.01, True), (0.51, True), (-0.9, False), (0.6, True)],
)
def test_positions_of_commands_have_two_unlike_bounds(value: float, beyond: bool) -> None:
    found = beyond_limits((ARM,), PositionsCommand(positions=(value,)))
    assert [one.joint for one in found] == ["arm"] * beyond
    assert (
        not found or f"{math.degrees(value):.6g} deg, outside its limits -57.3..+28.65 deg" in found[0].text
    )


@pytest.mark.parametrize("sign", [-1, 1])
def test_speeds_and_efforts_of_commands_have_a_magnitude(sign: int) -> None:
    assert beyond_limits((ARM,), VelocitiesCommand(velocities=(sign * 2.0,))) == []
    assert beyond_limits((ARM,), EffortsCommand(efforts=(sign * 0.5,))) == []
    (speed,) = beyond_limits((ARM,), VelocitiesCommand(velocities=(sign * 2.001,)))
    (effort,) = beyond_limits((ARM,), EffortsCommand(efforts=(sign * 0.501,)))
    assert speed.text == f"arm is commanded to {sign * 2.001:g} rad/s, more than 2 rad/s, its velocity limit"
    assert effort.text == f"arm is commanded to {sign * 0.501:g}, more than 0.5, its effort limit"
    (slow,) = beyond_limits((SLIDE,), VelocitiesCommand(velocities=(sign * 0.11,)))
    assert (
        slow.text
        == f"slide is commanded to {sign * 0.11:g} m/s, more than 0.1 m/s, the top speed of its servo"
    )
