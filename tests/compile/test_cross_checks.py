# ruff: noqa: E501 (a mistake and its sentence are read best side by side)
import json
import math

import pytest
from tests.kit.robots import PAIR, compile_text, problems_in


def broken(text: str, old: str, new: str) -> str:
    assert text.count(old) == 1, old
    return text.replace(old, new)


def place(text: str, word: str, nth: int = 0) -> tuple[int, int]:
    """Line and column, from 1, of the nth place of a word."""
    lines = text.splitlines()
    found = [(i + 1, line.index(word) + 1) for i, line in enumerate(lines) if word in line]
    return found[nth]


def test_a_right_file_has_no_problem():
    assert problems_in(PAIR) == ()


@pytest.mark.parametrize(
    ("change", "at", "says"),
    [
        (
            ("id: 2", "id: 1"),
            "1\n",
            ("error", "ID 1 of right_arm_joint is taken by left_arm_joint", "its own ID"),
        ),
        (
            ("    bus: main\n    id: 2", "    bus: mian\n    id: 2"),
            "mian",
            ("error", "bus mian, which is not defined", "did you mean main?"),
        ),
        (
            ("    id: 2\n    model: AX-12A", "    id: 2\n    model: AX-12AX"),
            "AX-12AX",
            ("error", "no control table for model AX-12AX of right_arm_joint", "did you mean AX-12A?"),
        ),
        (
            ("joint_group_posvel_controller", "joint_group_posvle_controller"),
            "joint_group_posvle_controller",
            (
                "error",
                "no plug-in offers the controller type joint_group_posvle_controller of arms",
                "did you mean joint_group_posvel_controller?",
            ),
        ),
        (
            (
                "posvel_controller\n    joints: [left_arm_joint, right_arm_joint]",
                "posvel_controller\n    joints: [left_arm_joint, right_arm_jiont]",
            ),
            "right_arm_jiont",
            ("error", "arms claims joint right_arm_jiont", "did you mean right_arm_joint?"),
        ),
        (
            (
                "posvel_controller\n    joints: [left_arm_joint, right_arm_joint]",
                "posvel_controller\n    joints: [left_arm_joint, left_arm_joint]",
            ),
            "left_arm_joint]",
            ("error", "arms names joint left_arm_joint twice", "once"),
        ),
        (
            (
                "active: false\n    joints: [left_arm_joint, right_arm_joint]",
                "active: true\n    joints: [ right_arm_joint]",
            ),
            "[ right_arm_joint]",
            ("error", "spare and arms are both active and both claim right_arm_joint", "active: false"),
        ),
        (
            ("rate: 25", "rate: 20"),
            "20}",
            ("error", "does not divide the loop's 50 Hz", "the nearest possible is 25"),
        ),
        (
            ("rate: 25", "rate: 100"),
            "100}",
            ("error", "above the loop's 50 Hz", "the nearest possible is 50"),
        ),
        (
            ("[-90 deg, 60 deg]", "[-90 deg, 90 deg]"),
            "[-90 deg",
            ("warning", "beyond the reach of its AX-12A, -240..+60 deg", "the joint will keep -90..+60 deg"),
        ),
        (
            ("[-90 deg, 60 deg]", "[70 deg, 90 deg]"),
            "[70 deg",
            ("error", "nothing in common with the reach of its AX-12A, -240..+60 deg", "check limits"),
        ),
        (
            ("[-90 deg, 60 deg]", "[0.05 deg, 0.1 deg]"),
            "[0.05 deg",
            ("error", "no position of an AX-12A lies within the limits", "wider than one tick (0.3 deg)"),
        ),
        (
            ("reference: 240 deg", "reference: 150 deg"),
            "150 deg",
            (
                "warning",
                "right_arm_joint is not a mirror image of left_arm_joint: its reference is 150 deg, "
                "mirrored it would be 240 deg",
                "not symmetric",
            ),
        ),
        (
            ("latency: 1 ms", "latency: 16 ms"),
            "50}",
            ("error", "takes 33.6 ms, but 50 Hz leave 20 ms", "1 ms"),
        ),
        (
            ("  main: {", "  other: {port: sim, protocol: 1.0, baud_rate: 57600}\n  main: {"),
            "other",
            ("warning", "bus other has no joint", "take it out"),
        ),
    ],
)
def test_one_mistake_is_one_problem_with_its_place(
    change: tuple[str, str], at: str, says: tuple[str, str, str]
):
    text = broken(PAIR, *change)
    severity, what, mend = says

    (problem,) = [p for p in problems_in(text) if p.severity == severity]

    line, column = place(text, "id: 1", 1) if at == "1\n" else place(text, at)
    offset = {"1\n": 4, "[ right_arm_joint]": 2}.get(at, 0)
    assert (problem.mark.line, problem.mark.column) == (line, column + offset)
    assert what in problem.what
    assert mend in problem.fix


def test_parameters_are_judged_by_the_controllers_own_model():
    text = broken(PAIR, "posvel_controller\n    joints:", "posvel_controller\n    jonits:")

    missing, unknown = sorted(problems_in(text), key=lambda p: p.mark)

    assert "controllers.arms has no joints" in missing.what
    assert (missing.mark.line, missing.mark.column) == place(text, "arms:")
    assert "unknown key 'jonits'" in unknown.what
    assert "did you mean joints?" in unknown.fix
    assert (unknown.mark.line, unknown.mark.column) == place(text, "jonits")


def test_a_reference_outside_the_travel_is_pointed_out():
    text = broken(PAIR, "reference: 240 deg", "reference: 310 deg")
    text = broken(text, "[-90 deg, 60 deg]", "[-90 deg, -20 deg]")

    found = [p for p in problems_in(text) if "the joint can never be at 0" in p.what]

    assert [(p.mark.line, p.mark.column) for p in found] == [place(text, "310 deg")]


def test_twins_that_turn_the_same_way_are_pointed_out():
    text = broken(PAIR, "direction: 1\n    limits: {position: [-90 deg, 60 deg]}", "direction: -1")

    (problem,) = problems_in(text)

    assert problem.severity == "warning"
    assert "both have direction -1" in problem.what
    assert (problem.mark.line, problem.mark.column) == (17, 16)


def test_two_buses_cannot_share_a_port():
    text = broken(
        PAIR,
        "  main: {",
        "  other: {port: /dev/ttyUSB0, protocol: 1.0, baud_rate: 1_000_000}\n  main: {",
    )

    assert any("port /dev/ttyUSB0 of bus main belongs to bus other" in p.what for p in problems_in(text))


def test_a_bus_that_is_too_slow_is_told_what_would_help():
    text = broken(PAIR, "latency: 1 ms", "latency: 16 ms")

    (problem,) = problems_in(text)

    # by hand: wire 580 us (2 x 8 + 18 bytes out, 2 x 12 in), delays 2 x 500 us, latency 2 x 16 ms
    assert "the highest possible rate is 29 Hz" in problem.what
    assert "an adapter latency of 1 ms instead of 16 ms would allow 279 Hz" in problem.fix
    assert "a return delay time of 0 us instead of 500 us would allow 30 Hz" in problem.fix


def test_a_bus_that_is_nearly_too_slow_is_a_warning():
    text = broken(PAIR, "rate: 50", "rate: 275").replace("rate: 25}", "rate: 275}")

    (problem,) = problems_in(text)

    assert problem.severity == "warning"
    assert "98% of the period" in problem.what


def test_errors_come_together_and_warnings_with_them():
    text = broken(PAIR, "id: 2", "id: 1")
    text = broken(text, "rate: 25", "rate: 20")
    text = broken(text, "reference: 240 deg", "reference: 150 deg")

    found = problems_in(text)

    assert [p.severity for p in found] == ["error", "error", "warning"]
    assert [p.mark for p in found[:2]] == sorted(p.mark for p in found[:2])


def test_servos_of_the_other_protocol_are_errors_and_hide_no_others():
    text = PAIR.replace("protocol: 1.0", "protocol: 2.0").replace(
        "[left_arm_joint, right", "[left_jiont, right", 1
    )

    what = [problem.what for problem in problems_in(text)]

    assert what == [
        "AX-12A of left_arm_joint speaks Protocol 1.0, bus main Protocol 2.0",
        "AX-12A of right_arm_joint speaks Protocol 1.0, bus main Protocol 2.0",
        "arms claims joint left_jiont, which is not defined",
    ]


def test_one_servo_of_the_other_protocol_hides_nothing_of_its_bus():
    """It is named by an alias, which its own protocol alone has."""
    text = (
        PAIR.replace("model: AX-12A", "model: AX-12", 1)
        .replace("rate: 50", "rate: 5000")
        .replace("rate: 25", "rate: 5000")
    )
    text = text.replace("protocol: 1.0", "protocol: 2.0").replace(
        "id: 2\n    model: AX-12A", "id: 2\n    model: XL430-W250"
    )

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


@pytest.fixture
def grouped() -> str:
    head, rest = PAIR.split("joints:\n", 1)
    named = rest[rest.index("controllers:") :].replace("[left_arm_joint, right_arm_joint]", "[arms]")
    return head + GROUPS + named


def test_groups_stand_for_joints_in_the_plan(grouped: str) -> None:
    compiled = compile_text(grouped, MOTION)
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
def test_mistakes_in_groups_have_a_place(grouped: str, right: str, wrong: str, expected: str) -> None:
    problems = [
        str(problem).partition("robot.yaml:")[2] for problem in problems_in(grouped.replace(right, wrong, 1))
    ]

    assert any(problem.startswith(expected) for problem in problems), problems
