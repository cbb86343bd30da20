"""A key of servos of a foreign package: in every form of a servo, written at the start and after a reboot."""

import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.kit.cases import case_parameters, read_head
from tests.kit.robot_cases import check_case
from tests.kit.robots import compile_text
from tests.kit.told_stories import check_story, story_parameters

from dxlrun.description.json_schema import robot_schema
from dxlrun.features import feature
from dxlrun.testing import installed

SERVO_KEY = """
from dxlrun.tooling.features import ServoKey
from dxlrun.tooling.files import key

STAGE = ServoKey(
    "glow",
    bool,
    field=key("Its servos glow.", "true", False),
    of_one=key("It glows; none: as the joint.", "true", None),
    of_section=key("It glows.", "true", False),
    before="motor",
)
"""
SETTINGS = """
from dxlrun.tooling.features import RegisterValue, SettingsStage
from dxlrun_glow.servo_key import STAGE as GLOW


def glow(file, servo, table):
    if not GLOW.value_of(servo):
        return
    led = table.items.get("led")
    if led is None:
        file.error(servo.mark(file.marks, "glow"), f"an {table.model} cannot glow", "remove it")
        return
    yield RegisterValue(led.address, led.size, 1, led.name)


STAGE = SettingsStage(glow)
"""
HERE = Path(__file__).parent
CASES = HERE / "cases" / "glow.txt"
ROBOT = read_head(CASES)


@pytest.fixture(autouse=True)
def with_glow(project: Callable[..., Path]) -> Iterator[None]:
    with installed(project("glow", servo_key=SERVO_KEY, settings=SETTINGS)):
        yield


@pytest.mark.parametrize("case", case_parameters(CASES))
def test_robot_file(case):
    check_case(case)


@pytest.mark.parametrize("case", [*story_parameters(HERE / "stories" / "glow.txt")])
def test_story(case, tmp_path):
    check_story(case, tmp_path)


def test_robot_without_the_key_does_not_use_the_package():
    sys.modules.pop("dxlrun_glow.settings", None)
    feature._stage.cache_clear()
    assert "dxlrun_glow" not in compile_text(re.sub(", glow: (true|false)", "", ROBOT)).plan.packages
    assert "dxlrun_glow.settings" not in sys.modules


def test_every_form_of_a_servo_is_in_the_schema():
    forms = robot_schema({}, {})["$defs"]
    having = {name for name, form in forms.items() if "glow" in form.get("properties", {})}
    assert having == {"Joint", "SharedJoint", "OneOfServos", "TransmissionServo", "Group"}
