"""The page of robot files and the schema say what the program does; marks are the places of values."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

import pytest
from tests.kit import desk
from tests.kit.pages import page_text

from dxlrun.cli.examples import schema_text
from dxlrun.description.base_form import Form
from dxlrun.description.document import Marks
from dxlrun.description.joints.motor_file import read_motor
from dxlrun.description.robot import robot_form
from dxlrun.errors import Mark

PAGE = page_text("robot-file.md")
EXAMPLES = re.findall(r"^```yaml\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
TABLES = set(re.findall(r"^<!-- keys: (\w+) -->$", PAGE, re.MULTILINE))
"""Sections whose tables docs/generate.py writes."""
WITHOUT_TABLE = {
    "Argument", "BareJoint", "Formula", "Group", "LoadForm", "MotionForm", "MotorForm", "PlugInEntry",
    "Point", "Processes", "Robot", "ServoEntry", "ServoJoint", "SharedJoint", "StribeckForm", "Target",
    "UncertaintyForm",
}  # fmt: skip
"""Forms that another table, or the text of the page, describes."""


def forms(kind: type[Form]) -> Iterator[type[Form]]:
    """Yield all forms of the program that are made of one."""
    for below in kind.__subclasses__():
        if below.__module__.startswith(("dxlrun.description.", "dxlrun.features.", "dxlrun_space.")):
            yield below
        yield from forms(below)


FORMS = {robot_form(), *forms(Form)}


def test_the_examples_of_the_page_are_read() -> None:
    robot, variant, groups, slide, shared, wrist, chain, motor, motion = EXAMPLES
    assert set(desk.robot(robot, {"port": "/dev/ttyUSB0"}).robot.joints) == {
        "head_pitch_joint",
        "head_yaw_joint",
    }
    desk.write(robot, "two_joints.yaml")
    assert (desk.robot(variant).robot.name, desk.robot(variant).robot.loop.rate) == ("two_joints_slow", 10)
    without = robot[: robot.index("controllers:")]
    assert desk.robot(without + chain).robot.controllers["arm"].into == ("arm_pid",)
    head = robot[: robot.index("joints:")]
    moved = {groups: "left_elbow", slide: "gripper", shared: "hip", wrist: "wrist_roll"}
    joints = [set(desk.robot(head + example).robot.joints) for example in moved]
    assert [joint in found for joint, found in zip(moved.values(), joints, strict=True)] == [True] * 4
    assert len(desk.motion(motion).motion.motions) == 2
    assert read_motor(desk.write(motor, "elbow.motor.yaml")).motor.p_gain == 32


def test_every_form_has_a_table_and_every_key_a_description_and_an_example() -> None:
    assert {one.__name__ for one in FORMS} - WITHOUT_TABLE == TABLES - {"robot", "motor"}
    fields = [(one, key, field) for one in FORMS for key, field in one.model_fields.items()]
    assert [(one, key) for one, key, field in fields if not field.description] == []
    assert {key for _, key, field in fields if not field.examples} == {"parameters"}


@pytest.mark.parametrize(
    ("part", "key"),
    [
        ("Adapter", "latency"),
        ("Bus", "return_delay_time"),
        ("Policies", "on_returned_servo"),
        ("Policies", "exit_timeout"),
    ],
)
def test_a_default_of_the_schema_is_that_of_the_program(part: str, key: str) -> None:
    value = json.loads(schema_text("robot"))["$defs"][part]["properties"][key]["default"]
    written = {
        "Bus": ("57600", f"57600, {key}: {value}"),
        "Adapter": ("57600", f"57600, adapter: {{{key}: {value}}}"),
        "Policies": ("loop:", f"policies: {{{key}: {value}}}\nloop:"),
    }
    robot = (
        "name: x\nbuses:\n  m: {port: sim, protocol: 1.0, baud_rate: 57600}\nloop: {rate: 1}\n"
        "joints: {j: {bus: m, id: 1, model: A, reference: 0 deg, direction: 1}}\n"
    )
    given = robot.replace(*written[part])
    assert given != robot
    assert desk.robot(given).robot == desk.robot(robot).robot


def test_marks_are_those_of_the_nearest_parent_that_is_in_the_file() -> None:
    at = {(): Mark("f", 2, 1), ("a",): Mark("f", 3, 3), ("a", 0): Mark("f", 3, 5)}
    marks = Marks("f", values=at, keys={("a",): Mark("f", 2, 1)})
    assert (marks.key("a"), marks.value("a")) == (Mark("f", 2, 1), Mark("f", 3, 3))
    assert marks.key("a", 0) == marks.value("a", 0) == Mark("f", 3, 5)  # an item of a list has only a value
    assert marks.value("a", 7, "x") == marks.key("nowhere") == Mark("f", 2, 1)
    assert Marks("f", {}, {}).value("a") == Mark("f", 1, 1)
