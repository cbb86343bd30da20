"""Values of commands against the limits of joints: those of the file, and those of the servos themselves."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dxlrun.compile.joints.limits import beyond_limits
from dxlrun.contract.controller import CommandModel, SpeedPeak
from dxlrun.plan.loop_plan import JointPlan
from dxlrun_controllers.group import (
    EffortsCommand,
    PosEffortCommand,
    PositionsCommand,
    PosVelCommand,
    VelocitiesCommand,
)
from dxlrun_controllers.motions.trajectory_command import (
    TrajectoryCommand,
    flat_trajectory,
    trajectory_speed_peaks,
)
from dxlwire.control_table import find_table

FREE = JointPlan("free", -2.0, 2.0, None, top_speed=8.0, top_effort=3.0)
BOUND = JointPlan("bound", -1.0, 1.0, 2.0, 0.5, top_speed=8.0, top_effort=3.0)
JOINTS = (FREE, BOUND)
FREE_SPEED = "more than 8 rad/s, the top speed of its servo"
BOUND_SPEED = "more than 2 rad/s, its velocity limit"


def trajectory(*points: tuple[float, tuple[float, float]], **more: object) -> TrajectoryCommand:
    return TrajectoryCommand.model_validate(
        {"points": [{"time": time, "positions": positions} | more for time, positions in points]}
    )


def longer(factor: float) -> str:
    return f": allow more time, {factor:g} times as long"


def peaks_of(command: CommandModel) -> list[SpeedPeak]:
    """Return what a joint_trajectory_controller of both joints says of a command."""
    if not isinstance(command, TrajectoryCommand):
        return []
    names = tuple(joint.name for joint in JOINTS)
    return list(trajectory_speed_peaks("trajectory", flat_trajectory(command, names), names))


@pytest.mark.parametrize(
    ("command", "sentences"),
    [
        (PositionsCommand(positions=(2.0, -1.0)), []),
        (
            PositionsCommand(positions=(math.radians(9999), -1.01)),
            [
                "free is sent to 9999 deg, outside its limits -114.59..+114.59 deg",
                "bound is sent to -57.8687 deg, outside its limits -57.3..+57.3 deg",
            ],
        ),
        (PositionsCommand(positions=(9.0,)), []),  # a wrong size is for `prepare`
        (PosVelCommand(positions=(0.0, 0.0), velocities=(-8.0, -2.0)), []),
        (
            PosVelCommand(positions=(0.0, 0.0), velocities=(1e300, 2.1)),
            [
                f"free is commanded to 1e+300 rad/s, {FREE_SPEED}",
                f"bound is commanded to 2.1 rad/s, {BOUND_SPEED}",
            ],
        ),
        (VelocitiesCommand(velocities=(-9.0, 0.0)), [f"free is commanded to -9 rad/s, {FREE_SPEED}"]),
        (PosEffortCommand(positions=(0.0, 0.0), efforts=(3.0, -0.5)), []),
        (
            EffortsCommand(efforts=(1e9, -0.6)),
            [
                "free is commanded to 1e+09, more than 3, the highest goal of its servo",
                "bound is commanded to -0.6, more than 0.5, its effort limit",
            ],
        ),
        (trajectory((0.0, (0.0, 0.0)), (0.25, (2.0, 0.5)), (0.5, (0.0, 0.0))), []),
        (
            trajectory((0.0, (0.0, 0.0)), (0.2, (2.0, 0.4)), (0.3, (2.0, 0.7))),
            [
                f"free is commanded to 10 rad/s at 0.200 s, from point 1 to 2, {FREE_SPEED}{longer(1.25)}",
                f"bound is commanded to 3 rad/s at 0.300 s, from point 2 to 3, {BOUND_SPEED}{longer(1.5)}",
            ],
        ),
        (
            trajectory((0.0, (0.0, 0.4)), (1.0, (0.0, -1.0)), velocities=(0.0, 0.0)),
            [f"bound is commanded to -2.1 rad/s at 0.500 s, from point 1 to 2, {BOUND_SPEED}{longer(1.05)}"],
        ),
        (
            TrajectoryCommand.model_validate(
                {"joints": ["bound"], "points": [{"time": 1, "positions": [1.5]}]}
            ),
            ["bound is sent to 85.9437 deg in point 1, outside its limits -57.3..+57.3 deg"],
        ),
        (
            trajectory((1.0, (0.0, 5.0)), velocities=(0.0, 3.0)),
            [
                "bound is sent to 286.479 deg in point 1, outside its limits -57.3..+57.3 deg",
                f"bound is commanded to 3 rad/s in point 1, {BOUND_SPEED}",
            ],
        ),
    ],
)
def test_each_value_beyond_a_limit_is_named_with_its_joint_and_the_limit(
    command: CommandModel, sentences: list[str]
) -> None:
    found = beyond_limits(JOINTS, command, peaks_of(command))
    assert [one.text for one in found] == sentences
    assert [one.joint for one in found] == [sentence.split()[0] for sentence in sentences]


def test_a_joint_of_which_no_limit_is_known_has_none() -> None:
    command = PosVelCommand(positions=(1e9, 0.0), velocities=(1e300, 0.0))
    joints = (JointPlan("wheel", -math.inf, math.inf, None), BOUND)
    assert beyond_limits(joints, command) == []


def test_the_first_point_may_be_at_once_and_points_may_be_out_of_order_without_a_speed() -> None:
    assert beyond_limits(JOINTS, trajectory((0.0, (2.0, 1.0)))) == []
    assert beyond_limits(JOINTS, trajectory((1.0, (2.0, 1.0)), (1.0, (0.0, 0.0)))) == []


def test_fields_that_are_no_numbers_of_joints_are_left_to_the_controller() -> None:
    class Odd(CommandModel):
        positions: dict[str, float]
        velocities: str
        points: tuple[int, ...]

    assert beyond_limits(JOINTS, Odd(positions={"free": 9.0}, velocities="ab", points=(1, 2))) == []


@pytest.mark.parametrize(("model", "protocol", "rpm"), [("XM430-W350", 2.0, 57.0), ("AX-12A", 1.0, 59.0)])
def test_the_top_speed_of_a_servo_is_not_below_what_its_manual_gives(
    model: str, protocol: float, rpm: float
) -> None:
    speed = find_table(model, protocol).top_speed
    assert rpm <= speed * 30 / np.pi < 1.4 * rpm
