# ruff: noqa: E501 (a mistake and its sentence are read best side by side)
"""Gears, slides, joints of several servos and transmissions: what they become, and what is refused where."""

from __future__ import annotations

import json
import math

import pytest
from msgspec.structs import replace
from tests.kit.robots import PAIR, compile_text, problems_in

from dxlrun.plan.robot_plan import from_json, to_json

TEXT = """\
name: body
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}
  other: {port: sim, protocol: 2.0, baud_rate: 57_600}
  old: {port: sim, protocol: 1.0, baud_rate: 1_000_000}
loop: {rate: 50}
joints:
  head: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1, gear_ratio: 2, limits: {effort: 1 A}}
  hip: {bus: main, model: XM430-W350, reference: 180 deg, direction: 1, servos: [{id: 2}, {id: 3, direction: -1}]}
  grip: {bus: main, id: 7, model: XM430-W350, reference: 180 deg, direction: 1, travel_per_turn: 90 mm, limits: {position: [0 mm, 40 mm]}}
  tail: {bus: old, id: 9, model: AX-12A, reference: 150 deg, direction: 1}
  pitch: {limits: {position: [-45 deg, 45 deg]}}
  roll: {}
transmissions:
  wrist:
    type: differential
    joints: [pitch, roll]
    servos:
      left: {bus: main, id: 5, model: XM430-W350, reference: 180 deg, direction: 1}
      right: {bus: main, id: 6, model: XM430-W350, reference: 180 deg, direction: -1}
controllers:
  all: {type: joint_group_position_controller, joints: [head, hip, grip, pitch, roll]}
poses:
  home: {head: 0 deg, grip: 10 mm}
policies: {on_exit: [{pose: home, speed: 60 deg/s, linear_speed: 20 mm/s}, limp], exit_timeout: 30 s}
"""


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
    assert (grip.linear, grip.lower, grip.upper) == (True, 0.0, 0.04)
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
    declared = {servo.own_name: servo.registers for bus in plan.buses for servo in bus.servos}
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
            for key in ("ratio", "name", "linear"):
                servo.pop(key, None)
    found = from_json(json.dumps(old).encode())
    assert not found.mechanics.coupled
    assert {servo.ratio for bus in found.buses for servo in bus.servos} == {1.0}


def test_an_ordinary_robot_has_no_mechanics() -> None:
    plan = compile_text(PAIR).plan
    assert not plan.mechanics.coupled
    assert [servo.row for bus in plan.buses for servo in bus.servos] == [0, 1]


def test_limits_of_velocity_and_effort_of_joints_together_are_warned_of() -> None:
    text = changed(
        (
            "pitch: {limits: {position: [-45 deg, 45 deg]}}",
            "pitch: {limits: {velocity: 4 rad/s, effort: 4 A}}",
        ),
        ("roll: {}", "roll: {limits: {velocity: 3 rad/s, effort: 4 A}}"),
    )
    says = [problem.what for problem in compile_text(text).warnings]
    assert any(
        "pitch and roll at their velocity limits servo wrist/left (ID 5) would need 7 rad/s" in one
        for one in says
    )
    assert any(
        "at their effort limits servo wrist/left (ID 5) would need 4 A, and has" in one for one in says
    )


REFUSED: list[tuple[tuple[str, str], str, str, str]] = [
    (("type: differential", "type: matrix\n    matrix: [[0.5, 0.5], [1.0, 1.0]]"), "[[0.5", "is singular", "multiples"),
    (("type: differential", "type: matrix\n    matrix: [[0.5, 0.5], [0.5, 0.503]]"), "[[0.5", "is nearly singular (condition number 669)", "100 is the most"),
    (("type: differential", "type: matrix\n    matrix: [[0.5, 0.5]]"), "[[0.5", "has 1 x 2, but its 2 joints and 2 servos ask for 2 x 2", "a row for each joint"),
    (("type: differential", "type: matrix\n    matrix: [[0.5, 0.5], [1]]"), "[[0.5", "has 2 uneven rows", "a row for each joint"),
    (("type: differential", "type: matrix"), "wrist:", "wrist has no matrix", "add `matrix:"),
    (("type: differential", "type: differential\n    matrix: [[1, 0], [0, 1]]"), "matrix", "whose matrix is known", "type: matrix"),
    (("joints: [pitch, roll]", "joints: [pitch]"), "wrist:", "is a differential with 2 servos and 1 joints", "two of each"),
    (("joints: [pitch, roll]\n", "joints: [pitch, rol]\n"), "rol]", "moves joint rol, which is not defined", "roll"),
    (("joints: [pitch, roll]\n", "joints: [pitch, pitch]\n"), "pitch]\n    servos", "pitch is moved by transmission wrist already", "once"),
    (("joints: [pitch, roll]\n", "joints: [pitch, head]\n"), "head]\n    servos", "head has a servo of its own", "take bus, id"),
    (("  roll: {}", "  roll: {}\n  spare: {}"), "spare", "spare has no servo, and no transmission moves it", "name it in a transmission"),
    (("left: {bus: main, id: 5", "left: {bus: main, id: 2"), "2, model: XM430-W350, reference: 180 deg, direction: 1}", "servo ID 2 of wrist/left is taken by hip", "its own ID"),
    (("head: {bus: main, id: 1,", "head: {bus: main, id: 253,"), "253", "servo ID 253 of head is not valid in Protocol 2.0", "from 0 to 252"),
    (("[{id: 2}, {id: 3", "[{id: 2}, {id: 2"), "2, direction: -1}]", "servo ID 2 of hip is taken by servo 1 of the same joint on bus main", "its own ID"),
    (("type: differential", "type: matrix\n    matrix: [[1.0e+300, 0], [0, 1.0e+300]]"), "[[1.0e", "the matrix of wrist moves a joint by 1e+300 rad for a rad of a servo", "0.0001 to 100 for each joint"),
    (("type: differential", "type: matrix\n    matrix: [[1.0e-300, 0], [0, 1.0e-300]]"), "[[1.0e", "the matrix of wrist moves a joint by 1e-300 rad for a rad of a servo", "0.0001 to 100"),
    (("  wrist:", "  head:"), "head:\n    type", "head is the name of a joint already, and both name servos", "another name"),
    (("{id: 3, direction: -1}", "{id: 3, bus: other}"), "other}]", "ID 2 and ID 3 move hip together, but one bus runs at 1000000 baud, the other at 57600", "one baud rate"),
    (("{id: 3, direction: -1}", "{id: 3, bus: old, model: AX-12A}"), "old,", "one speaks Protocol 2.0, the other 1.0", "one protocol"),
    (("{id: 3, direction: -1}", "{id: 3, model: XL430-W250}"), "XL430", "one measures its load, the other its current", "one model"),
    (("{id: 3, direction: -1}", "{id: 3, model: auto}"), "auto", "so its model is not asked for", "write its model"),
    (("roll: {}", "roll: {limits: {position: [-150 deg, 150 deg]}}"), "[-45 deg", "with pitch at +45 deg and roll at +150 deg servo wrist/left (ID 5) would have to be at 375 deg, but it goes from 0 to 359.91 deg", "narrower"),
    (("roll: {}", "roll: {continuous: true}"), "true", "continuous of roll is another than that of the other joints of transmission wrist", "alike"),
    (("roll: {}", "roll: {torque: off}"), "off", "torque of roll is another", "alike"),
    (("[0 mm, 40 mm]", "[0 deg, 40 mm]"), "0 deg, 40 mm", "grip is linear, and its position is in rad", "[0 mm, 40 mm]"),
    (("travel_per_turn: 90 mm,", "travel_per_turn: 90 mm, gear_ratio: 3.5,"), "3.5", "grip is linear, and has no gear_ratio", "travel_per_turn is its gear"),
    (("travel_per_turn: 90 mm,", "travel_per_turn: 90 mm, simulation: {inertia: 1 kg m^2},"), "1 kg m^2", "grip is linear, and has no inertia", "mass: 0.2 kg"),
    (("roll: {}", "roll: {simulation: {mass: 1 kg}}"), "1 kg", "roll turns, and has no mass", "inertia: 0.01"),
    (("roll: {}", "roll: {simulation: {friction: 1 N}}"), "1 N", "roll turns, and its friction is in N", "0.05 Nm"),
    (("limits: {effort: 1 A}", "limits: {velocity: 3 mm/s}"), "3 mm/s", "head turns, and its velocity is in m/s", "2 rad/s"),
    (("grip: 10 mm", "grip: 10 deg"), "10 deg", "grip is linear, and pose home has it in rad", "20 mm"),
    (("head: 0 deg", "head: 0 mm"), "0 mm, grip", "head turns, and pose home has it in m", "60 deg"),
    ((", linear_speed: 20 mm/s", ""), "{pose: home", "brings grip, which is linear, to pose home at no speed", "linear_speed"),
    (("gear_ratio: 2", "gear_ratio: 1.0e-9"), "1.0e-9, limits", "must be at least 0.01", "2.5"),
    (("gear_ratio: 2", "gear_ratio: -2"), "-2, limits", "must be at least 0.01", "2.5"),
    (("travel_per_turn: 90 mm", "travel_per_turn: 1.0e-300 m"), "1.0e-300 m", "must be at least 1e-05", "94.2 mm"),
    (("{id: 3, direction: -1}]", "{id: 3, direction: -1}], tolerance: 21 deg"), "21 deg", "a tolerance above 20 deg", "3 deg"),
    (("[{id: 2}, {id: 3, direction: -1}]", "[{id: 2}]"), "[{id: 2}]", "has too few entries", "at least 2"),
    (("joint_group_position_controller, joints: [head, hip, grip, pitch, roll]", "joint_group_velocity_controller, joints: [pitch]"), "pitch]}\npo", "all commands a velocity alone of pitch, but not of roll, which the same servos move", "command roll too"),
    (("joint_group_position_controller, joints: [head, hip, grip, pitch, roll]", "joint_group_pwm_controller, joints: [pitch, roll]"), "pitch, roll]}\npo", "all commands a PWM, but the servos of transmission wrist are not moved together by it", "use a controller"),
    (("exit_timeout", "groups: {hand: {joints: [roll], on_lost_servo: limp}}, exit_timeout"), "[roll]", "group hand has a joint of a transmission without pitch", "add pitch"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "at", "what", "fix"), REFUSED)
def test_one_mistake_is_one_sentence_at_its_place(
    change: tuple[str, str], at: str, what: str, fix: str
) -> None:
    text = changed(change)
    found = [problem for problem in problems_in(text) if problem.severity == "error" and what in problem.what]
    assert found, [problem.what for problem in problems_in(text)]
    assert fix in found[0].fix
    index = text.index(at)
    line = text.count("\n", 0, index) + 1
    assert (found[0].mark.line, found[0].mark.column) == (line, index - (text.rfind("\n", 0, index) + 1) + 1)


def test_servos_without_a_common_angle_and_servos_of_different_speeds() -> None:
    far = "{id: 3, model: XM430-W350, reference: 720 deg}"
    (error,) = [p for p in problems_in(changed(("{id: 3, direction: -1}", far))) if p.severity == "error"]
    assert "the servos of hip have no angle of the joint in common" in error.what
    slow = compile_text(changed(("{id: 3, direction: -1}", "{id: 3, model: XM540-W270}"))).warnings
    assert any("differ in their top speeds" in warning.what for warning in slow)


def test_a_motion_gives_linear_joints_lengths() -> None:
    motion = (
        "name: m\nmotions:\n  - controller: all\n    points:\n      - {time: 1 s, joints: {head: {position: 5 deg}, "
        "hip: {position: 0 deg}, grip: {position: §}, pitch: {position: 0 deg}, roll: {position: 0 deg}}}\n"
    )
    plan = compile_text(TEXT, motion.replace("§", "20 mm")).plan
    assert plan.loop.commands
    (problem,) = [p for p in problems_in(TEXT, motion.replace("§", "20 deg")) if p.severity == "error"]
    assert problem.what == "grip is linear, and its position is in rad"
    assert problem.mark.line == 5
