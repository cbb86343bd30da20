# ruff: noqa: E501 (a mistake and its sentence are read best side by side)
"""Limits and properties of joints, for motions, commands and clients: each side, each sign, and the bound itself."""

import dataclasses
import json
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from tests.kit.robots import compile_text, robot_text

from dxlrun.cli import check
from dxlrun.compile.joints.limits import Interval, beyond_limits, degrees, limits_of
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.contract.controller import CommandModel, SpeedPeak
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.errors import Mark
from dxlrun.output.text_table import Table
from dxlrun.plan.loop_plan import JOINT_PROPERTIES, JointPlan, JointProperty, JointValues
from dxlrun.remote.preparation import Preparation, RefusedRequest
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
from dxlwire.control_table import all_tables, find_table
from dxlwire.joint_unit import LINEAR

MARK = Mark("m.yaml", 3, 5)
ARM = JointPlan("arm", -1.0, 0.5, 2.0, 0.5, top_speed=8.0, top_effort=3.0)
SLIDE = JointPlan("slide", -0.02, 0.05, None, top_speed=0.1, top_effort=3.0, unit=LINEAR)
FREE = JointPlan("free", -2.0, 2.0, None, top_speed=8.0, top_effort=3.0)
JOINTS = (FREE, ARM)
RANGE = "outside its limits -57.3..+28.65 deg"
FREE_SPEED = "more than 8 rad/s, the top speed of its servo"
ARM_SPEED = "more than 2 rad/s, its velocity limit"
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
def test_interval_contains_what_is_inside_on_both_sides(lower: float, upper: float, inside: bool) -> None:
    assert limits_of(ARM).contains(Interval(lower, upper)) is inside


def test_intervals_meet_in_the_tighter_bound_of_each_side() -> None:
    assert Interval(-3, 1).meet(Interval(-2, 4)) == Interval(-2, 4).meet(Interval(-3, 1)) == Interval(-2, 1)
    assert Interval(-3, -1).meet(Interval(-1, 2)) is None  # a point
    assert Interval(-3, -2).meet(Interval(-1, 2)) is None
    assert Interval(-3, 1).scaled(2.0, LINEAR) == Interval(-6, 2, LINEAR)
    assert (limits_of(ARM), limits_of(SLIDE)) == (Interval(-1, 0.5), Interval(-0.02, 0.05, LINEAR))


def test_positions_are_written_with_their_signs_and_short() -> None:
    assert (str(limits_of(ARM)), str(limits_of(SLIDE))) == ("-57.3..+28.65 deg", "-20..+50 mm")
    assert [degrees(value) for value in (math.radians(60), -1e-9, 1.77)] == ["60", "0", "101.41"]


def trajectory(*points: tuple[float, tuple[float, float]], **more: object) -> TrajectoryCommand:
    return TrajectoryCommand.model_validate(
        {"points": [{"time": time, "positions": positions} | more for time, positions in points]}
    )


def beyond(command: CommandModel) -> list[str]:
    """Return what is said of a command for a controller of both joints; each names its joint first."""
    names = tuple(joint.name for joint in JOINTS)
    peaks: list[SpeedPeak] = []
    if isinstance(command, TrajectoryCommand):
        peaks = [*trajectory_speed_peaks("trajectory", flat_trajectory(command, names), names)]
    found = beyond_limits(JOINTS, command, peaks)
    assert all(one.text.startswith(f"{one.joint} is ") for one in found)
    return [one.text for one in found]


@pytest.mark.parametrize(
    ("command", "sentences"),
    [
        (PositionsCommand(positions=(2.0, -1.0)), []),
        (PositionsCommand(positions=(-2.0, 0.5)), []),
        (
            PositionsCommand(positions=(math.radians(9999), -1.01)),
            ["free is sent to 9999 deg, outside its limits -114.59..+114.59 deg", f"arm is sent to -57.8687 deg, {RANGE}"],
        ),
        (PositionsCommand(positions=(-2.01, 0.51)), ["free is sent to -115.165 deg, outside its limits -114.59..+114.59 deg", f"arm is sent to 29.2208 deg, {RANGE}"]),
        (PositionsCommand(positions=(9.0,)), []),  # a wrong size is for `prepare`
        (PosVelCommand(positions=(0.0, 0.0), velocities=(-8.0, -2.0)), []),
        (
            PosVelCommand(positions=(0.0, 0.0), velocities=(1e300, 2.1)),
            [f"free is commanded to 1e+300 rad/s, {FREE_SPEED}", f"arm is commanded to 2.1 rad/s, {ARM_SPEED}"],
        ),
        (VelocitiesCommand(velocities=(-9.0, -2.001)), [f"free is commanded to -9 rad/s, {FREE_SPEED}", f"arm is commanded to -2.001 rad/s, {ARM_SPEED}"]),
        (PosEffortCommand(positions=(0.0, 0.0), efforts=(3.0, -0.5)), []),
        (
            EffortsCommand(efforts=(1e9, -0.6)),
            ["free is commanded to 1e+09, more than 3, the highest goal of its servo", "arm is commanded to -0.6, more than 0.5, its effort limit"],
        ),
        (trajectory((0.0, (2.0, 0.5))), []),  # the first point may be at once
        (trajectory((0.0, (0.0, 0.0)), (0.25, (2.0, 0.5)), (0.5, (0.0, 0.0))), []),
        (
            trajectory((0.0, (0.0, 0.0)), (0.2, (2.0, 0.4)), (0.3, (2.0, 0.1))),
            [
                f"free is commanded to 10 rad/s at 0.200 s, from point 1 to 2, {FREE_SPEED}: allow more time, 1.25 times as long",
                f"arm is commanded to -3 rad/s at 0.300 s, from point 2 to 3, {ARM_SPEED}: allow more time, 1.5 times as long",
            ],
        ),
        (
            trajectory((0.0, (0.0, 0.4)), (1.0, (0.0, -1.0)), velocities=(0.0, 0.0)),
            [f"arm is commanded to -2.1 rad/s at 0.500 s, from point 1 to 2, {ARM_SPEED}: allow more time, 1.05 times as long"],
        ),
        (
            TrajectoryCommand.model_validate({"joints": ["arm"], "points": [{"time": 1, "positions": [1.5]}]}),
            [f"arm is sent to 85.9437 deg in point 1, {RANGE}"],
        ),
        (
            trajectory((1.0, (0.0, 5.0)), velocities=(0.0, 3.0)),
            [f"arm is sent to 286.479 deg in point 1, {RANGE}", f"arm is commanded to 3 rad/s in point 1, {ARM_SPEED}"],
        ),
    ],
)  # fmt: skip
def test_each_value_beyond_a_limit_is_named_with_its_joint_and_the_limit(
    command: CommandModel, sentences: list[str]
) -> None:
    assert beyond(command) == sentences


def test_limits_that_are_not_known_and_fields_that_are_no_numbers_of_joints_are_left_out() -> None:
    class Odd(CommandModel):
        positions: dict[str, float]
        velocities: str
        points: tuple[int, ...]

    wheel = JointPlan("wheel", -math.inf, math.inf, None)
    assert beyond_limits((wheel,), PosVelCommand(positions=(1e9,), velocities=(1e300,))) == []
    assert beyond_limits(JOINTS, Odd(positions={"free": 9.0}, velocities="ab", points=(1, 2))) == []
    (slow,) = beyond_limits((SLIDE,), VelocitiesCommand(velocities=(-0.11,)))
    assert slow.text == "slide is commanded to -0.11 m/s, more than 0.1 m/s, the top speed of its servo"


@pytest.mark.parametrize(("model", "protocol", "rpm"), [("XM430-W350", 2.0, 57.0), ("AX-12A", 1.0, 59.0)])
def test_top_speed_of_a_servo_is_not_below_what_its_manual_gives(
    model: str, protocol: float, rpm: float
) -> None:
    assert rpm <= find_table(model, protocol).top_speed * 30 / np.pi < 1.4 * rpm


@pytest.mark.parametrize(
    ("controller", "kind", "slow", "fast", "place"),
    [
        ("arm", "trajectory", {"points": [(1.0, 0.0), (2.21, 0.8)]}, {"points": [(1.0, 0.0), (2.0, 0.8)]}, "from point 1 to 2"),
        ("poses", "play", {"motion": "there"}, {"motion": "there", "speed": 2.0}, "on the way to step 2 of there"),
    ],
)  # fmt: skip
def test_command_of_a_client_is_refused_for_its_peak(
    controller: str, kind: str, slow: dict[str, object], fast: dict[str, object], place: str
) -> None:
    loop = compile_text(robot_text("peaks")).plan.loop
    preparation = Preparation({joint.name: joint for joint in loop.joints}, load_plugins())
    plan = next(one for one in loop.controllers if one.name == controller)

    def send(fields: dict[str, object]) -> None:
        if "points" in fields:
            points = [{"time": time, "positions": [at], "velocities": [0.0]} for time, at in fields["points"]]  # type: ignore[attr-defined]  # a row above
            fields = {"points": points}
        preparation.command(plan, kind, json.dumps(fields).encode()).require_within_limits()

    send(slow)
    with pytest.raises(RefusedRequest) as refused:
        send(fast)
    said = f"elbow is commanded to 1.2 rad/s at 1.500 s, {place}, more than 1 rad/s, its velocity limit"
    assert f"{said}: allow more time, 1.2 times as long" in str(refused.value)


def test_values_of_a_command_belong_to_the_joints_that_it_names():
    class Named(CommandModel):
        joints: list[str]
        positions: list[float]

    found = beyond_limits(JOINTS, Named(joints=["arm", "free"], positions=[0.4, 1.5]))
    assert found == []
    (beyond,) = beyond_limits(JOINTS, Named(joints=["arm", "free"], positions=[0.6, 1.5]))
    assert beyond.joint == "arm"


ROBOT = Path(__file__).parents[2] / "robots" / "mechanics.yaml"


def _joint_table() -> tuple[list[dict[str, object]], Table]:
    compiled = compile_files(ROBOT, {}, [])
    return compiled.report["joints"], next(iter(check._tables(compiled)))


def test_property_with_a_column_is_in_json_and_table(monkeypatch: pytest.MonkeyPatch) -> None:
    wide = JointProperty("tolerance", lambda joint: joint.goal_tolerance, column="")
    monkeypatch.setattr("dxlrun.compile.check_report.JOINT_PROPERTIES", (*JOINT_PROPERTIES, wide))
    rows, table = _joint_table()
    assert all(row["tolerance"] for row in rows)
    names = [column.name for column in table.columns]
    cells = {row[0].text: row[names.index("tolerance")].text for row in table.rows}
    assert cells["knee"] == "5"
    assert cells["gripper"] == "5 mm"


def test_limit_of_the_servo_is_marked_in_the_table() -> None:
    rows, table = _joint_table()
    column = [one.name for one in table.columns].index("velocity")
    assert rows
    for row, cells in zip(rows, table.rows, strict=True):
        assert cells[column].text.endswith("(servo)") == (row["velocity_source"] == "servo")


def test_running_robot_lists_the_same_properties() -> None:
    joints = compile_files(ROBOT, {}, []).plan.loop.joints
    values = JointValues.from_joints(joints, {})
    fields = {one.listed for one in JOINT_PROPERTIES if one.listed}
    assert fields | {"effort_units", "joint_keys"} == {one.name for one in dataclasses.fields(JointValues)}
    found = msgspec.to_builtins(values)
    assert found["units"].keys() == found["speeds"].keys() == {joint.name for joint in joints}
    assert [name for name, unit in found["units"].items() if unit == "m"] == ["gripper"]
    assert found["limits"].keys() == {joint.name for joint in joints if joint.bounded}


SPAN = """\
name: span
buses: {{main: {{port: sim, protocol: {protocol}, baud_rate: 1_000_000, adapter: {{latency: 0 ms}}}}}}
loop: {{rate: 50}}
joints:
  left_arm_joint: {{bus: main, id: 1, model: "{model}", reference: {left:.12f} rad, direction: 1}}
  right_arm_joint: {{bus: main, id: 2, model: "{model}", reference: {right:.12f} rad, direction: -1}}
"""


@pytest.mark.parametrize(
    "table", [table for table in all_tables() if not table.firmware], ids=lambda table: table.model
)
def test_a_joint_reaches_every_goal_position_of_its_model(table):
    low, high = table.min_tick * table.rad_per_tick, table.max_tick * table.rad_per_tick
    left = low + 0.25 * (high - low)
    text = SPAN.format(protocol=table.protocol, model=table.model, left=left, right=low + high - left)
    compiled = compile_text(text)
    ticks = [(servo.lower_tick, servo.upper_tick) for servo in compiled.plan.buses[0].servos]
    assert ticks == [(table.min_tick, table.max_tick)] * 2
    reached = [value for joint in compiled.plan.loop.joints for value in (joint.lower, joint.upper)]
    assert reached == pytest.approx([low - left, high - left] * 2)
    assert compiled.warnings == (), "the reference is in the travel, and the twins are mirror images"


@pytest.mark.parametrize(("left", "count"), [(-3.1, 0), (-3.2, 2)])
def test_a_reference_outside_of_a_travel_to_both_sides_of_0_is_a_warning(left: float, count: int):
    text = SPAN.format(protocol=2.0, model="PH54-200-S500", left=left, right=-left)
    found = [one.what.partition("S500 ")[2] for one in compile_text(text).warnings]
    assert found == ["(-180..180 deg), so the joint cannot reach 0"] * count
