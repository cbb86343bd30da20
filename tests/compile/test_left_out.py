import pytest
from tests.kit.robots import PAIR, problems_in


def test_mistakes_of_form_and_of_meaning_come_together():
    text = (
        PAIR.replace("direction: -1", "direction: 0")  # form
        .replace("    id: 2", "    id: 1")  # meaning; the other owner of the ID has a wrong form
        .replace("rate: 25", "rate: 20")  # meaning
        .replace("posvel_controller", "posvle_controller")  # meaning
        .replace("active: false", "active: off")  # form
        + "colour: red\n"  # form
    )

    found = [(p.mark.line, p.what) for p in problems_in(text)]

    assert [line for line, _ in found] == [11, 14, 20, 22, 26, 28]
    assert "direction is 0" in found[0][1]
    assert "servo ID 1 of right_arm_joint is taken by left_arm_joint" in found[1][1]
    assert "does not divide" in found[2][1]
    assert "no plug-in offers" in found[3][1]
    assert "active is the text 'off'" in found[4][1]
    assert "unknown key 'colour'" in found[5][1]


def test_nothing_is_said_about_what_refers_to_a_part_of_a_wrong_form():
    # all joints stand on a bus that cannot be read, and all controllers name them
    (problem,) = problems_in(PAIR.replace("baud_rate: 1_000_000", "baud_rate: quick"))

    assert "baud_rate is the text 'quick'" in problem.what


def test_nothing_is_said_about_rates_when_the_loop_has_none():
    (problem,) = problems_in(PAIR.replace("rate: 50", "rate: 0"))

    assert "loop.rate is 0" in problem.what


def test_a_joint_of_a_wrong_form_is_not_missed_by_its_controllers():
    text = PAIR.replace("reference: 60 deg", "reference: 60").replace("id: 2", "id: 2\n    colour: red")

    assert [p.mark.line for p in problems_in(text)] == [10, 15]


def test_what_is_no_yaml_at_all_is_one_problem():
    (problem,) = problems_in(PAIR + "  - [\n")

    assert problem.severity == "error"


def test_a_motion_for_a_controller_of_a_wrong_form_is_not_blamed():
    text = PAIR.replace("arms:\n", "arms:\n    active: maybe\n")
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


def test_a_part_of_which_nothing_is_left_does_not_hide_the_other_mistakes():
    text = PAIR.replace("rate: 25", "rate: 20") + "model: {urdf: 5}\n"

    assert [p.mark.line for p in problems_in(text)] == [20, 28]


BUS = (
    ("protocol: 1.0", "protocol: 3.0"),
    ("baud_rate: 1_000_000", "baud_rate: fast"),
    ("port: /dev/ttyUSB0", "port: 5"),
    ("adapter: {latency: 1 ms}", "adapter: {latncy: 1 ms}"),
)


@pytest.mark.parametrize("change", BUS)
def test_a_wrong_key_of_a_bus_hides_no_other_mistake(change: tuple[str, str]):
    text = (
        PAIR.replace(*change)
        .replace("bus: main\n    id: 2", "bus: mian\n    id: 2")
        .replace("reference: 60 deg", "reference: 60")
        .replace("model: AX-12A", "model: XX-7", 1)
        .replace("joint_state_broadcaster", "joint_state_brodcaster")
    )

    found = [(p.mark.line, p.what) for p in problems_in(text)]

    assert [line for line, _ in found] == [3, 9, 10, 13, 20]
    assert "no control table for model XX-7" in found[1][1]
    assert "has no unit" in found[2][1]
    assert "right_arm_joint is on bus mian" in found[3][1]
    assert "no plug-in offers the controller type joint_state_brodcaster" in found[4][1]


@pytest.mark.parametrize(
    "change",
    [
        *BUS,
        ("loop: {rate: 50}", "loop: {rate: -50}"),
        ("loop: {rate: 50}", "loop: {rate: quick}"),
        ("bus: main\n    id: 2", "bus: {}\n    id: 2"),
        ("id: 2", "id: two"),
        ("model: AX-12A\n    reference: 240 deg", "model: [AX-12A]\n    reference: 240 deg"),
        ("reference: 240 deg", "reference: 240"),
        ("direction: 1\n", "direction: 0\n"),
        ("rate: 25}", "rate: 0}"),
        ("active: false", "active: maybe"),
    ],
)
def test_a_single_mistake_of_form_is_a_single_problem(change: tuple[str, str]):
    """What is guessed in its place is not told as another one, and neither is what depends on the guess."""
    text = PAIR.replace("limits: {", "limits: {effort: 40 %, ") + (
        "policies: {on_exit: [{pose: home, speed: 60 deg/s}, limp], exit_timeout: 4 s}\n"
        "poses: {home: {right_arm_joint: 10 deg}}\n"
    )
    assert [problem for problem in problems_in(text) if problem.severity == "error"] == []
    assert text.count(change[0]) == 1

    (problem,) = problems_in(text.replace(*change))

    assert problem.mark.line == text[: text.index(change[0])].count("\n") + 1


def test_a_servo_of_two_firmwares_on_an_unknown_bus_is_not_judged_by_one():
    text = PAIR.replace(
        "bus: main\n    id: 2\n    model: AX-12A",
        "bus: mian\n    id: 2\n    model: MX-28\n    registers: {position_p_gain: 800}",
    )

    (problem,) = problems_in(text)

    assert "bus mian" in problem.what


def test_nothing_is_said_about_states_of_a_sensor_or_device_that_is_wrong():
    wrong = (
        "devices:\n  foot: {bus: nowhere, id: 101, model: generic}\n"
        "sensors:\n  unit: {type: serial_imu, port: /dev/ttyUSB1, baud: 9600}\n"
        "  quick: {type: serial_imu, port: /dev/ttyUSB2, rate: 0}\n"
        "controllers:\n"
        "  first: {type: imu_sensor_broadcaster, sensor: unit}\n"
        "  second: {type: imu_sensor_broadcaster, sensor: quick}\n"
        "  third: {type: sensor_broadcaster, message: Range, fields: {range: foot/register_1}}\n"
    )
    found = [p.what for p in problems_in(PAIR.replace("controllers:\n", wrong)) if p.severity == "error"]

    assert len(found) == 3, found
    assert "foot is on bus nowhere" in found[0]
    assert "unknown key 'baud'" in found[1]
    assert "rate is 0" in found[2]
