# ruff: noqa: E501 (a mistake and its sentence are read best side by side)
"""Gears, slides, joints of several servos and transmissions: what they become, and what is refused where."""

from __future__ import annotations

import json
import math

import pytest
from msgspec.structs import replace
from tests.kit.robots import PAIR, compile_text, problems_in, robot_text

from dxlrun.plan.robot_plan import from_json, to_json
from dxlwire.joint_unit import LINEAR

TEXT = robot_text("mechanics")


def changed(*changes: tuple[str, str]) -> str:
    text = TEXT
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return text


def test_what_the_robot_becomes() -> None:
    plan = compile_text(TEXT).plan
    head, hip, grip, tail, pitch, roll = plan.loop.joints
    servos = {servo.own_name: servo for bus in plan.buses for servo in bus.servos}
    assert list(plan.mechanics.servos) == [
        "head",
        "hip/1",
        "hip/2",
        "grip",
        "tail",
        "wrist/left",
        "wrist/right",
    ]
    assert [servos[name].row for name in plan.mechanics.servos] == [*range(7)]
    assert servos["head"].ratio == 0.5
    assert (head.lower, head.upper) == pytest.approx((-math.pi / 2, math.pi / 2), abs=1e-3)
    assert head.top_speed == pytest.approx(hip.top_speed / 2)
    assert (grip.unit, grip.lower, grip.upper) == (LINEAR, 0.0, 0.04)
    assert servos["grip"].ratio == pytest.approx(0.09 / math.tau)
    assert servos["grip"].upper_tick == math.floor(2048 + 40 / 90 * 4096)
    assert (hip.servo, hip.coupled, pitch.coupled) == ("ID 2 and 3 on bus main", (), ("pitch", "roll"))
    assert (servos["hip/2"].direction, servos["hip/2"].joint) == (-1, "hip")
    # the servos reach 180 deg, pitch takes 45 of them
    assert math.degrees(roll.upper) == pytest.approx(135, abs=0.2)
    assert roll.velocity == pytest.approx(roll.top_speed / 2)  # both joints at once need the servos twice
    assert hip.top_effort == pytest.approx(2 * head.top_effort)
    assert tail.servo == "ID 9 on bus old"
    assert from_json(to_json(plan)) == plan


@pytest.mark.parametrize("pitch", ["[-90 deg, 0 deg]", "[0 deg, 90 deg]"])
def test_a_joint_without_limits_gets_what_the_others_leave_on_either_side(pitch: str) -> None:
    roll = compile_text(changed(("[-45 deg, 45 deg]", pitch))).plan.loop.joints[-1]
    assert (math.degrees(roll.lower), math.degrees(roll.upper)) == pytest.approx((-90, 90), abs=0.2)


def test_a_servo_of_a_joint_may_have_registers_of_its_own() -> None:
    own = "{id: 3, direction: -1, registers: {position_p_gain: 900}}"
    plan = compile_text(changed(("{id: 3, direction: -1}", own))).plan
    declared = {servo.own_name: servo.settings for bus in plan.buses for servo in bus.servos}
    assert declared["hip/1"] == ()
    assert [(one.name, one.value) for one in declared["hip/2"]] == [("position_p_gain", 900)]


def test_a_torque_grows_with_the_gear_and_a_current_does_not() -> None:
    (head,) = compile_text(TEXT).joints[0].servos
    straight = replace(head, described=replace(head.described, ratio=1.0))
    assert head.top_effort == straight.top_effort
    torque = replace(head.table, effort_unit="Nm")
    assert replace(head, table=torque).top_effort == 2 * (replace(straight, table=torque).top_effort or 0.0)


def test_a_plan_of_before_ratios_decodes_as_what_it_was() -> None:
    plan = compile_text(TEXT).plan
    old = json.loads(to_json(plan))
    del old["mechanics"]
    for bus in old["buses"]:
        for servo in bus["servos"]:
            for key in ("ratio", "name", "unit"):
                servo.pop(key, None)
    found = from_json(json.dumps(old).encode())
    assert not found.mechanics.coupled
    assert {servo.ratio for bus in found.buses for servo in bus.servos} == {1.0}


def test_a_plan_of_log_format_8_has_the_units_of_its_joints() -> None:
    said = 'a "linear":true inside a text'
    plan = replace(compile_text(TEXT).plan, source_text=said)
    old = to_json(plan).replace(b'"unit":"m"', b'"linear":true').replace(b'"unit":"rad"', b'"linear":false')
    assert b'"unit"' not in old
    assert from_json(old) == plan
    assert [joint.name for joint in from_json(old).loop.joints if joint.unit is LINEAR] == ["grip"]


def test_an_ordinary_robot_has_no_mechanics() -> None:
    plan = compile_text(PAIR).plan
    assert not plan.mechanics.coupled
    assert [servo.row for bus in plan.buses for servo in bus.servos] == [0, 1]


def test_a_motion_gives_linear_joints_lengths() -> None:
    motion = (
        "name: m\nmotions:\n  - controller: all\n    points:\n      - {time: 1 s, joints: {head: {position: 5 deg}, "
        "hip: {position: 0 deg}, grip: {position: §}, pitch: {position: 0 deg}, roll: {position: 0 deg}}}\n"
    )
    plan = compile_text(TEXT, motion.replace("§", "20 mm")).plan
    assert plan.loop.commands
    (problem,) = [p for p in problems_in(TEXT, motion.replace("§", "20 deg")) if p.severity == "error"]
    assert problem.what == "grip is linear, so its position cannot be in rad"
    assert problem.mark.line == 5
