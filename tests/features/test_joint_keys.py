"""A key of joints of a foreign package: that of the page add-a-section.md, checked, executed and shown."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import Mock, call

import numpy as np
import pytest
from msgspec import structs
from tests.kit.cases import case_parameters, read_head
from tests.kit.kept_events import Events
from tests.kit.robot_cases import check_case
from tests.kit.robots import compile_text
from tests.kit.told_stories import check_story, story_parameters

from dxlrun.channels.cycle import Commands, States
from dxlrun.cli import check
from dxlrun.description.joints import joint_forms
from dxlrun.description.joints.joint_forms import kind_of_joint
from dxlrun.description.json_schema import robot_schema
from dxlrun.description.robot import robot_form
from dxlrun.dynamixel.hardware_layer import HardwareLayer, HardwareLayers
from dxlrun.features.mechanics.joint_hardware import JointHardware
from dxlrun.plan.loop_plan import JointValues
from dxlrun.plan.robot_plan import from_json, to_json
from dxlrun.testing import installed

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "add-a-section.md"
ROBOTS = Path(__file__).parents[2] / "robots"
HERE = Path(__file__).parent
CASES = HERE / "cases" / "backlash.txt"
ROBOT = read_head(CASES)
SLIDE = """\
  slide:
    {bus: main, id: 3, model: AX-12A, reference: 150 deg, direction: 1, travel_per_turn: 94 mm,
     backlash: 0.1 mm}
"""
STRICT = "Annotated[tuple[Position, Position], Field(strict=False)]"


@pytest.fixture(autouse=True)
def with_backlash(project: Callable[..., Path]) -> Iterator[None]:
    """Install the package whose files are on the page, or named there."""
    section = PAGE.read_text().partition("## A key of joints")[2]
    files = {path.stem: path.read_text() for path in Path(__file__).with_name("backlash").glob("*.py")}
    files["joint_key"] = re.findall(r"```python\n(.*?)```", section, re.S)[0]
    with installed(project("backlash", **files)):
        yield
    robot_form.cache_clear()


def mechanics_with_backlash() -> str:
    """Return a robot with a coupled joint that has the key."""
    text = (ROBOTS / "mechanics.yaml").read_text().replace("model: {urdf: urdf/mechanics.urdf}\n", "")
    return re.sub(r"(wrist_roll: *\{)", r"\1backlash: 1 deg, ", text)


@pytest.mark.parametrize("case", case_parameters(CASES))
def test_robot_file(case):
    check_case(case)


@pytest.mark.parametrize("case", [*story_parameters(HERE / "stories" / "backlash.txt")])
def test_story(case, tmp_path):
    check_story(case, tmp_path)


def test_joint_of_a_transmission_may_have_the_key():
    plan = compile_text(mechanics_with_backlash()).plan
    assert [joint.name for joint in plan.loop.joints if joint.keys] == ["wrist_roll"]
    assert from_json(to_json(plan)) == plan


def test_key_with_a_name_like_a_key_of_servos_makes_no_joint_with_a_servo(monkeypatch):
    assert kind_of_joint({"lead": "1 mm"}) == "<one servo>"  # means travel_per_turn
    lead = structs.replace(joint_forms.joint_keys()[0], name="lead")
    monkeypatch.setattr(joint_forms, "joint_keys", lambda: [lead])
    assert kind_of_joint({"lead": "1 mm"}) == "<no servo>"


def test_layer_of_a_joint_key_is_above_the_servos_of_couplings():
    plan = compile_text(mechanics_with_backlash()).plan
    joints, servos = len(plan.loop.joints), len(plan.mechanics.servos)
    layers = HardwareLayers(plan, States.empty(joints), Commands.empty(joints), Events())
    assert [len(layer.goals.position) for layer in layers._layers] == [joints, servos]
    assert len(layers.goals.position) == servos > joints
    assert layers.refusals is not None
    built = layers.build(HardwareLayer(None))
    assert type(built).__name__ == "BacklashLayer"
    assert isinstance(built._hardware, JointHardware)


def test_layer_forwards_every_call_that_it_does_not_change():
    below, done, modes = Mock(), Mock(), np.zeros(2, np.uint8)
    layer = HardwareLayer(below)
    calls = [
        call.start(done), call.read_states(), call.write_goals(), call.set_modes(modes),
        call.write_register(1, "led", 2, done), call.read_register(1, "led", done),
        call.switch_torque(1, False, done), call.follow_goals([1]), call.reboot_servo(1, done),
        call.limit_torque(0.5), call.idle(2, 1), call.stop(), call.leave_torque_on(),
    ]  # fmt: skip
    found = [getattr(layer, name)(*given) for name, given, _ in calls]
    assert below.mock_calls == calls
    assert found == [below.stop.return_value if one == call.stop() else None for one in calls]
    assert layer.servo_limits is below.servo_limits
    public = {name for name in vars(HardwareLayer) if not name.startswith("_")}
    assert public == {"servo_limits", *(name for name, *_ in calls)}


def test_check_shows_the_key_as_a_column():
    found = compile_text(ROBOT + SLIDE)
    assert [row["backlash"] for row in found.report["joints"]] == [np.radians(4), None, 1e-4]
    table = next(iter(check._tables(found)))
    column = [one.name for one in table.columns].index("backlash")
    assert [row[column].text for row in table.rows] == ["4", "none", "0.1 mm"]


@pytest.mark.parametrize(
    ("name", "form", "example", "written"),
    [
        ("window", f"{STRICT} | None", "[-1 rad, 1 rad]", "[-1.0, 1.0]"),
        ("play", "Position | Literal['auto'] | None", "1 deg", "auto"),
    ],
)
def test_check_shows_values_that_are_not_a_number(  # noqa: PLR0917  parameters
    tmp_path, project, capsys, name, form, example, written
):
    stage = (
        "from typing import Annotated, Literal\n\nfrom pydantic import Field\n\n"
        "from dxlrun import LINEAR, ROTARY\nfrom dxlrun.tooling.features import JointKey\n"
        "from dxlrun.tooling.files import Position, key\n\n"
        f"STAGE = JointKey({name!r}, {form}, key('It.', '{example}', None), value=object,\n"
        f"    examples={{ROTARY: '{example}', LINEAR: '{example}'}})\n"
    )
    value = written.replace(".0", " rad")
    (tmp_path / "robot.yaml").write_text(ROBOT.replace("backlash: 4 deg", f"{name}: {value}"))
    with installed(project(name, joint_key=stage)):
        assert check.check_robot(tmp_path / "robot.yaml") == 0
    assert written in capsys.readouterr().out


def test_no_column_while_no_joint_has_the_key():
    table = next(iter(check._tables(compile_text(ROBOT.replace(", backlash: 4 deg", "")))))
    assert "backlash" not in [one.name for one in table.columns]


def test_clients_of_a_run_get_the_key():
    values = JointValues.from_joints(compile_text(ROBOT).plan.loop.joints, {})
    assert values.joint_keys == {"backlash": {"knee": np.radians(4)}}


def test_key_is_in_the_schema():
    schema = robot_schema({}, {})
    names = [*schema["$defs"]["Joint"]["properties"]]
    assert names[names.index("simulation") - 1] == "backlash"
    assert "backlash" in schema["properties"]["joint_defaults"]["properties"]
    assert "Play of the gear" in schema["$defs"]["BareJoint"]["properties"]["backlash"]["description"]
