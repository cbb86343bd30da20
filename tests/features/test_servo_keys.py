"""A key of servos of a foreign package: in every form of a servo, written at the start and after a reboot."""

import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.kit.cases import case_parameters, read_head
from tests.kit.robot_cases import check_case
from tests.kit.robots import compile_text

from dxlrun.description.json_schema import robot_schema
from dxlrun.features import feature
from dxlrun.testing import installed, simulated_robot
from dxlsim.servo.protocol2_servo import Protocol2Servo

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
CASES = Path(__file__).parent / "cases" / "glow.txt"
ROBOT = read_head(CASES)
GLOWING = {1, 3, 5}


@pytest.fixture(autouse=True)
def with_glow(project: Callable[..., Path]) -> Iterator[None]:
    with installed(project("glow", servo_key=SERVO_KEY, settings=SETTINGS)):
        yield


@pytest.mark.parametrize("case", case_parameters(CASES))
def test_robot_file(case):
    check_case(case)


def test_robot_without_the_key_does_not_use_the_package():
    sys.modules.pop("dxlrun_glow.settings", None)
    feature._stage.cache_clear()
    assert "dxlrun_glow" not in compile_text(re.sub(", glow: (true|false)", "", ROBOT)).plan.packages
    assert "dxlrun_glow.settings" not in sys.modules


def test_every_form_of_a_servo_is_in_the_schema():
    forms = robot_schema({}, {})["$defs"]
    having = {name for name, form in forms.items() if "glow" in form.get("properties", {})}
    assert having == {"Joint", "SharedJoint", "OneOfServos", "TransmissionServo", "Group"}


def test_start_and_return_write_the_setting(tmp_path):
    (tmp_path / "robot.yaml").write_text(ROBOT)
    robot = simulated_robot(tmp_path / "robot.yaml", duration_s=3.0)
    servos, leds = robot.buses[0].servos, list[set[int]]()

    def look() -> None:
        leds.append({servo.servo_id for servo in servos if servo.registers["led"]})

    robot.buses[0].at(500_000_000, look)
    first = robot.buses[0].servo(1)
    assert isinstance(first, Protocol2Servo)
    robot.buses[0].at(600_000_000, first.reboot)
    robot.buses[0].at(610_000_000, look)
    robot.buses[0].at(2_800_000_000, look)
    robot.run()
    assert leds == [GLOWING, GLOWING - {1}, GLOWING]
