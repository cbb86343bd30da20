"""A key of servos of a foreign package: in every form of a servo, written at the start and after a reboot."""

import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.kit.robots import compile_text

from dxlrun import InputError
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
ROBOT = """name: lamps
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {latency: 1 ms}, return_delay_time: 500 us}
loop: {rate: 50}
policies: {on_returned_servo: hold}
joint_defaults: {bus: main, model: XL430-W250, reference: 180 deg, direction: 1}
joints:
  bright: {id: 1, glow: true, registers: {position_p_gain: 700}}
  dark: {id: 2}
  both: {servos: [{id: 3}, {id: 4, glow: false}], glow: true}
  roll: {}
  pitch: {}
transmissions:
  wrist:
    type: differential
    joints: [roll, pitch]
    servos:
      left: {bus: main, id: 5, model: XL430-W250, reference: 180 deg, direction: 1, glow: true}
      right: {bus: main, id: 6, model: XL430-W250, reference: 180 deg, direction: -1}
"""
GLOWING = {1, 3, 5}


@pytest.fixture(autouse=True)
def with_glow(project: Callable[..., Path]) -> Iterator[None]:
    with installed(project("glow", servo_key=SERVO_KEY, settings=SETTINGS)):
        yield


def test_each_servo_has_the_value_of_its_own_or_of_its_joint():
    plan = compile_text(ROBOT).plan
    assert {servo.servo_id for servo in plan.buses[0].servos if "led" in servo.declared} == GLOWING
    assert plan.buses[0].servos[0].declared == {"position_p_gain": 700, "led": 1}
    assert plan.packages["dxlrun_glow"] == "dxlrun-glow"


def test_key_of_a_later_feature_counts():
    text = ROBOT.replace("registers: {position_p_gain: 700}", "registers: {led: 0}")
    settings = compile_text(text).plan.buses[0].servos[0].settings
    assert [(one.name, one.value) for one in settings] == [("led", 1)]


def test_robot_without_the_key_does_not_use_the_package():
    sys.modules.pop("dxlrun_glow.settings", None)
    feature._stage.cache_clear()
    assert "dxlrun_glow" not in compile_text(re.sub(", glow: (true|false)", "", ROBOT)).plan.packages
    assert "dxlrun_glow.settings" not in sys.modules


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("glow: false", "glow: maybe", r"yaml:10:42: joints.both.servos\[1\].glow is the text 'maybe'"),
        ("id: 2}", "id: 2, model: PH42-020-S300-R, glow: true}", "cannot glow"),
        ("roll: {}", "roll: {glow: true}", "roll"),
    ],
)
def test_mistake_is_named_at_its_place(old, new, said):
    assert old in ROBOT
    with pytest.raises(InputError, match=said):
        compile_text(ROBOT.replace(old, new))


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
