"""Properties of joints: declared once, and shown by `check` and by a running robot."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import msgspec
import pytest

from dxlrun.cli import check
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.output.text_table import Table
from dxlrun.plan.loop_plan import JOINT_PROPERTIES, JointProperty, JointValues

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
