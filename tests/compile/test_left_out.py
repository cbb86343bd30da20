from collections.abc import Callable

from dxlrun.errors import Problem

Find = Callable[..., tuple[Problem, ...]]


def test_mistakes_of_form_and_of_meaning_come_together(problems_in: Find, robot_text: str):
    text = (
        robot_text.replace("direction: -1", "direction: 0")  # form
        .replace("    id: 2", "    id: 1")  # silent: the other owner of the ID has a wrong form
        .replace("rate: 25", "rate: 20")  # meaning
        .replace("posvel_controller", "posvle_controller")  # meaning
        .replace("active: false", "active: off")  # form
        + "colour: red\n"  # form
    )

    found = [(p.mark.line, p.what) for p in problems_in(text)]

    assert [line for line, _ in found] == [11, 20, 22, 26, 28]
    assert "direction is 0" in found[0][1]
    assert "does not divide" in found[1][1]
    assert "no plug-in offers" in found[2][1]
    assert "active is the text 'off'" in found[3][1]
    assert "unknown key 'colour'" in found[4][1]


def test_nothing_is_said_about_what_refers_to_a_part_of_a_wrong_form(problems_in: Find, robot_text: str):
    # all joints stand on a bus that cannot be read, and all controllers name them
    (problem,) = problems_in(robot_text.replace("baud_rate: 1_000_000", "baud_rate: quick"))

    assert "baud_rate is the text 'quick'" in problem.what


def test_nothing_is_said_about_rates_when_the_loop_has_none(problems_in: Find, robot_text: str):
    (problem,) = problems_in(robot_text.replace("rate: 50", "rate: 0"))

    assert "loop.rate is 0" in problem.what


def test_a_joint_of_a_wrong_form_is_not_missed_by_its_controllers(problems_in: Find, robot_text: str):
    text = robot_text.replace("reference: 60 deg", "reference: 60").replace("id: 2", "id: 2\n    colour: red")

    assert [p.mark.line for p in problems_in(text)] == [10, 15]


def test_what_is_no_yaml_at_all_is_one_problem(problems_in: Find, robot_text: str):
    (problem,) = problems_in(robot_text + "  - [\n")

    assert problem.severity == "error"


def test_a_motion_for_a_controller_of_a_wrong_form_is_not_blamed(problems_in: Find, robot_text: str):
    text = robot_text.replace("arms:\n", "arms:\n    active: maybe\n")
    motion = """\
    name: m
    motions:
      - {controller: arms, duration: 1 s, samples: 2, joints: {left_arm_joint: {position: t}}}
      - {controller: amrs, duration: 1 s, samples: 2, joints: {left_arm_joint: {position: t +}}}
    """

    found = [p.what for p in problems_in(text, motion)]

    assert len(found) == 3
    assert "formula 't +' cannot be read" in found[0] + found[1]
    assert "no controller amrs" in found[0] + found[1]
    assert "active is the text 'maybe'" in found[2]


def test_a_part_of_which_nothing_is_left_does_not_hide_the_other_mistakes(problems_in: Find, robot_text: str):
    text = robot_text.replace("rate: 25", "rate: 20") + "model: {urdf: 5}\n"

    assert [p.mark.line for p in problems_in(text)] == [20, 28]
