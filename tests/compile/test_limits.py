"""Limits and properties of joints; of motions: motion.txt and peaks.txt, of clients: requests/limits.txt."""

import dataclasses
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from tests.kit.robots import compile_text

from dxlrun.cli import check
from dxlrun.compile.joints.limits import Interval, beyond_limits, degrees, limits_of
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.contract.controller import CommandModel
from dxlrun.output.text_table import Table
from dxlrun.plan.loop_plan import JOINT_PROPERTIES, JointPlan, JointProperty, JointValues
from dxlrun_controllers.group import PositionsCommand, PosVelCommand, VelocitiesCommand
from dxlwire.control_table import all_tables, find_table
from dxlwire.joint_unit import LINEAR

ARM = JointPlan("arm", -1.0, 0.5, 2.0, 0.5, top_speed=8.0, top_effort=3.0)
SLIDE = JointPlan("slide", -0.02, 0.05, None, top_speed=0.1, top_effort=3.0, unit=LINEAR)
FREE = JointPlan("free", -2.0, 2.0, None, top_speed=8.0, top_effort=3.0)
JOINTS = (FREE, ARM)


def test_intervals_contain_what_is_inside_and_meet_in_the_tighter_bound_of_each_side() -> None:
    inside = [(-1.0, 0.5), (-1.0 - 5e-7, 0.5 + 5e-7), (0, 0), (-1.001, 0.5), (-1.0, 0.501)]
    assert [limits_of(ARM).contains(Interval(*each)) for each in inside] == [True] * 3 + [False] * 2
    assert Interval(-3, 1).meet(Interval(-2, 4)) == Interval(-2, 4).meet(Interval(-3, 1)) == Interval(-2, 1)
    assert Interval(-3, -1).meet(Interval(-1, 2)) is None  # a point
    assert Interval(-3, -2).meet(Interval(-1, 2)) is None
    assert Interval(-3, 1).scaled(2.0, LINEAR) == Interval(-6, 2, LINEAR)
    assert (limits_of(ARM), limits_of(SLIDE)) == (Interval(-1, 0.5), Interval(-0.02, 0.05, LINEAR))


def test_positions_are_written_with_their_signs_and_short() -> None:
    assert (str(limits_of(ARM)), str(limits_of(SLIDE))) == ("-57.3..+28.65 deg", "-20..+50 mm")
    assert [degrees(value) for value in (math.radians(60), -1e-9, 1.77)] == ["60", "0", "101.41"]


def test_limits_that_are_not_known_and_fields_that_are_no_numbers_of_joints_are_left_out() -> None:
    class Odd(CommandModel):
        positions: dict[str, float]
        velocities: str
        points: tuple[int, ...]

    wheel = JointPlan("wheel", -math.inf, math.inf, None)
    assert beyond_limits(JOINTS, PositionsCommand(positions=(9.0,))) == []  # a wrong size is for `prepare`
    assert beyond_limits((wheel,), PosVelCommand(positions=(1e9,), velocities=(1e300,))) == []
    assert beyond_limits(JOINTS, Odd(positions={"free": 9.0}, velocities="ab", points=(1, 2))) == []
    (slow,) = beyond_limits((SLIDE,), VelocitiesCommand(velocities=(-0.11,)))
    assert slow.text == "slide is commanded to -0.11 m/s, more than 0.1 m/s, the top speed of its servo"


@pytest.mark.parametrize(("model", "protocol", "rpm"), [("XM430-W350", 2.0, 57.0), ("AX-12A", 1.0, 59.0)])
def test_top_speed_of_a_servo_is_not_below_what_its_manual_gives(
    model: str, protocol: float, rpm: float
) -> None:
    assert rpm <= find_table(model, protocol).top_speed * 30 / np.pi < 1.4 * rpm


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


def test_margin_of_a_pose_ignores_joints_without_limits(tmp_path: Path) -> None:
    text = SPAN.format(protocol=2.0, model="XM430-W350", left=3, right=3)
    poses = "poses: {turned: {left_arm_joint: 1 rad}, both: {left_arm_joint: 1 rad, right_arm_joint: 1 rad}}"
    (tmp_path / "span.yaml").write_text(
        text.replace("direction: 1}", "direction: 1, continuous: true}") + poses
    )
    compiled = compile_files(tmp_path / "span.yaml", {}, [])
    assert [row["margin_joint"] for row in compiled.report["poses"]] == ["", "right_arm_joint"]
    (table,) = (one for one in check._tables(compiled) if one.title == "Poses")
    assert [row[1].text.rpartition(" ")[2] for row in table.rows] == ["", "right_arm_joint"]


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
