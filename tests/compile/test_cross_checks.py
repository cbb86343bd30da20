# ruff: noqa: E501 (a mistake and its sentence are read best side by side)
import json
import math

import pytest
from tests.kit import desk
from tests.kit.robots import PAIR, compile_text, problems_in

BOTH = "posvel_controller\n    joints: [left_arm_joint, right_arm_joint]"
ONE = [
    ("id: 2", "id: §1", "error: servo ID 1 of right_arm_joint is taken by left_arm_joint on bus main", "its own ID"),
    ("    bus: main\n    id: 2", "    bus: §mian\n    id: 2", "error: right_arm_joint is on bus mian, which is not defined", "did you mean main?"),
    ("    id: 2\n    model: AX-12A", "    id: 2\n    model: §AX-12AX", "error: no control table for model AX-12AX of right_arm_joint", "did you mean AX-12A?"),
    ("joint_group_posvel_controller", "§joint_group_posvle_controller", "error: no plug-in offers the controller type joint_group_posvle_controller of arms", "did you mean joint_group_posvel_controller?"),
    (BOTH, BOTH.replace("right_arm_joint", "§right_arm_jiont"), "error: arms claims joint right_arm_jiont", "did you mean right_arm_joint?"),
    (BOTH, BOTH.replace("right_arm_joint", "§left_arm_joint"), "error: arms names joint left_arm_joint twice", "once"),
    ("active: false\n    joints: [left_arm_joint, right_arm_joint]", "active: true\n    joints: [§right_arm_joint]", "error: spare and arms are both active and both claim right_arm_joint", "active: false"),
    ("rate: 25", "rate: §20", "error: rate 20 Hz of states does not divide the loop's 50 Hz", "the nearest possible is 25"),
    ("rate: 25", "rate: §100", "error: rate 100 Hz of states is above the loop's 50 Hz", "the nearest possible is 50"),
    ("[-90 deg, 60 deg]", "§[-90 deg, 90 deg]", "warning: limits -90..+90 deg of right_arm_joint go beyond the reach of its AX-12A, -240..+60 deg", "the joint will keep -90..+60 deg"),
    ("[-90 deg, 60 deg]", "§[70 deg, 90 deg]", "error: limits +70..+90 deg of right_arm_joint have nothing in common with the reach of its AX-12A, -240..+60 deg", "check limits"),
    ("[-90 deg, 60 deg]", "§[0.05 deg, 0.1 deg]", "error: no position of an AX-12A lies within the limits", "wider than one tick (0.3 deg)"),
    ("reference: 240 deg", "reference: §150 deg", "warning: right_arm_joint is not a mirror image of left_arm_joint: its reference is 150 deg, mirrored it would be 240 deg", "not symmetric"),
    ("direction: 1\n    limits: {position: [-90 deg, 60 deg]}", "direction: §-1", "warning: right_arm_joint is not a mirror image of left_arm_joint: both have direction -1", "not symmetric"),
    ("latency: 1 ms}}\nloop: {rate: 50}", "latency: 16 ms}}\nloop: {rate: §50}", "error: one cycle on bus main takes 33.6 ms, but 50 Hz leave 20 ms; the highest possible rate is 29 Hz", "an adapter latency of 1 ms instead of 16 ms would allow 279 Hz"),
    ("latency: 1 ms}}\nloop: {rate: 50}", "latency: 16 ms}}\nloop: {rate: §50}", "error: one cycle on bus main takes 33.6 ms", "a return delay time of 0 us instead of 500 us would allow 30 Hz"),
    ("  main: {", "  §other: {port: sim, protocol: 1.0, baud_rate: 57600}\n  main: {", "warning: bus other has no joint", "take it out"),
    ("  main: {port: /dev/ttyUSB0", "  other: {port: /dev/ttyUSB0, protocol: 1.0, baud_rate: 1_000_000}\n  main: {port: §/dev/ttyUSB0", "error: port /dev/ttyUSB0 of bus main belongs to bus other already", "one port is one bus"),
    ("posvel_controller\n    joints:", "posvel_controller\n    §jonits:", "error: controllers.arms has an unknown key 'jonits'", "did you mean joints?"),
]  # fmt: skip
"""Right, wrong with the place of the problem, severity and what, fix. Of the slow bus by hand: wire 580 us (2 x 8 +
18 bytes out, 2 x 12 in), delays 2 x 500 us, latency 2 x 16 ms."""


def test_a_right_file_has_no_problem():
    assert problems_in(PAIR) == ()


@pytest.mark.parametrize(("right", "wrong", "what", "fix"), ONE)
def test_one_mistake_is_one_problem_with_its_place(right: str, wrong: str, what: str, fix: str):
    assert PAIR.count(right) == 1
    text, at = desk.pointed(PAIR, right, wrong)
    severity = what.partition(":")[0]
    *_, problem = [one for one in problems_in(text) if one.severity == severity]
    assert f"{problem.mark.line}:{problem.mark.column}" == at
    assert f"{severity}: {problem.what}".startswith(what)
    assert fix in problem.fix


def test_parameters_are_judged_by_the_controllers_own_model():
    found = problems_in(PAIR.replace("posvel_controller\n    joints:", "posvel_controller\n    jonits:"))
    assert [(problem.mark.line, problem.what.partition(";")[0]) for problem in found] == [
        (21, "controllers.arms has no joints"),
        (23, "controllers.arms has an unknown key 'jonits'"),
    ]


def test_a_reference_outside_the_travel_is_pointed_out():
    text = PAIR.replace("[-90 deg, 60 deg]", "[-90 deg, -20 deg]")
    text, at = desk.pointed(text, "reference: 240 deg", "reference: §310 deg")
    (found,) = [one for one in problems_in(text) if "the joint can never be at 0" in one.what]
    assert f"{found.mark.line}:{found.mark.column}" == at


def test_a_bus_that_is_nearly_too_slow_is_a_warning():
    (problem,) = problems_in(PAIR.replace("rate: 50", "rate: 275").replace("rate: 25}", "rate: 275}"))
    assert problem.severity == "warning"
    assert "98% of the period" in problem.what


def test_errors_come_together_and_warnings_with_them():
    text = PAIR.replace("id: 2", "id: 1").replace("rate: 25", "rate: 20")
    found = problems_in(text.replace("reference: 240 deg", "reference: 150 deg"))
    assert [p.severity for p in found] == ["error", "error", "warning"]
    assert [p.mark for p in found[:2]] == sorted(p.mark for p in found[:2])


def test_servos_of_the_other_protocol_are_errors_and_hide_no_others():
    text = PAIR.replace("protocol: 1.0", "protocol: 2.0").replace("[left_arm_joint", "[left_jiont", 1)
    assert [problem.what for problem in problems_in(text)] == [
        "AX-12A of left_arm_joint speaks Protocol 1.0, bus main Protocol 2.0",
        "AX-12A of right_arm_joint speaks Protocol 1.0, bus main Protocol 2.0",
        "arms claims joint left_jiont, which is not defined",
    ]


def test_one_servo_of_the_other_protocol_hides_nothing_of_its_bus():
    """It is named by an alias, which its own protocol alone has."""
    text = PAIR.replace("AX-12A", "AX-12", 1).replace("AX-12A", "XL430-W250")
    text = text.replace("protocol: 1.0", "protocol: 2.0")
    text = text.replace("rate: 50", "rate: 5000").replace("rate: 25", "rate: 5000")
    what = [problem.what for problem in problems_in(text)]
    assert what[0].startswith("one cycle on bus main takes ")
    assert "AX-12 of left_arm_joint speaks Protocol 1.0, bus main Protocol 2.0" in what


GROUPS = """\
joint_defaults: {bus: main, model: AX-12A}
groups:
  arms: {joints: [left_arm_joint, right_arm_joint]}
joints:
  left_arm_joint: {id: 1, reference: 60 deg, direction: -1}
  right_arm_joint: {id: 2, reference: 240 deg, direction: 1, limits: {position: [-90 deg, 60 deg]}}
"""
MOTION = """\
name: nod
motions:
- controller: arms
  points:
  - {time: 1 s, joints: {arms: {position: 10 deg, velocity: 1 rad/s}, left_arm_joint: {position: 0 deg, velocity: 1 rad/s}}}
"""


HEAD, REST = PAIR.split("joints:\n", 1)
NAMED = REST[REST.index("controllers:") :].replace("[left_arm_joint, right_arm_joint]", "[arms]")
GROUPED = HEAD + GROUPS + NAMED


def test_groups_stand_for_joints_in_the_plan() -> None:
    compiled = compile_text(GROUPED, MOTION)
    plan, both = compiled.plan, ("left_arm_joint", "right_arm_joint")

    assert (plan.groups, compiled.report["groups"]) == ({"arms": both}, {"arms": both})
    assert [one.joints for one in plan.loop.controllers if one.command] == [both, both]
    assert "arms" not in plan.loop.controllers[1].parameters
    (command,) = plan.loop.commands
    assert json.loads(command.request)["positions"] == pytest.approx([0.0, math.radians(10)])


@pytest.mark.parametrize(
    ("right", "wrong", "expected"),
    [
        ("model: AX-12A", "model: AX-12C", "5:36: no control table for model AX-12C of left_arm_joint (and 1 joint more); "),
        ("joints: [arms]", "joints: [left_arm_joint]", "7:3: group arms has other joints than controller arms, and both names mean joints; call one of them otherwise"),
        ("[arms]", "[arms, left_arm_joint]", "15:20: arms names joint left_arm_joint twice; name it once"),
        ("[arms]", "[amrs]", "15:14: arms claims joint amrs, which is not defined; did you mean arms?"),
    ],
)  # fmt: skip
def test_mistakes_in_groups_have_a_place(right: str, wrong: str, expected: str) -> None:
    problems = [
        str(problem).partition("robot.yaml:")[2] for problem in problems_in(GROUPED.replace(right, wrong, 1))
    ]

    assert any(problem.startswith(expected) for problem in problems), problems
