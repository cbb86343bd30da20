import re

import pytest
from tests.kit.answers import read_answer, result_of

TEN_MISTAKES = """\
name: ten mistakes
arguments:
  port: {default: sim, help: "serial port"}
buses:
  main: {port: "${prot}", protocol: 1.0, baud_rate: fast}
loop:
  rate: 0
joints:
  head_joint: {bus: main, id: 254, model: AX-12A, reference: 150, direction: 1}
  neck_joint: {bus: main, id: 2, model: AX-12A, reference: 150 deg, direction: 2}
  neck_joint: {bus: main, id: 3, model: AX-12A, reference: 150 deg, direction: 1}
  tail: {bus: main, id: 4, model: AX-12, reference: 150 grad, direction: 1, limits: {position: [2 rad,0 rad]}}
colour: red
"""

TEN = [  # line and the word that is wrong
    (1, "ten mistakes"),
    (5, '"${prot}"'),
    (5, "fast"),
    (7, "0"),
    (9, "254"),
    (9, "150,"),
    (10, "2}"),
    (11, "neck_joint"),
    (12, "150 grad"),
    (12, "[2 rad"),
    (13, "colour"),
]

CROSSED = """\
name: crossed
buses:
  main: {port: /dev/ttyUSB0, protocol: 1.0, baud_rate: 57600}
loop: {rate: 200}
joints:
  left_joint: {bus: main, id: 1, model: AX-12A, reference: 150 deg, direction: 1}
  neck_joint: {bus: mian, id: 2, model: AX-12A, reference: 150 deg, direction: 1}
  back_joint: {bus: main, id: 1, model: AX-12A, reference: 150 deg, direction: 1}
  tail: {bus: main, id: 4, model: AX-21X, reference: 150 deg, direction: 1}
  nose: {bus: main, id: 5, model: AX-12A, reference: 0 deg, direction: 1, limits: {position: [-9 deg,-8 deg]}}
controllers:
  states: {type: joint_state_broadcaster, rate: 150}
  head: {type: joint_group_position_controller, joints: [left_joint, neck_jiont]}
  body: {type: joint_group_position_controller, joints: [left_joint, back_joint]}
  tail: {type: joint_group_posvel_controller, joints: [back_joint], speed: 3}
  more: {type: joint_group_posvel_controller, joints: [back_joint]}
  less: {type: joint_group_velocity_controler, joints: [back_joint]}
"""

CROSSED_TEN = [
    (4, "200"),  # too fast for the bus
    (7, "mian"),
    (8, "1, model"),  # taken
    (9, "AX-21X"),
    (10, "[-9 deg"),  # out of reach
    (12, "150"),  # does not divide 200
    (13, "neck_jiont"),
    (15, "speed"),
    (16, "back_joint"),  # claimed by body already
    (17, "joint_group_velocity_controler"),
]


def marked(text: str, words: list[tuple[int, str]]) -> list[tuple[int, int]]:
    """Line and column of each word."""
    lines = text.splitlines()
    return [(line, lines[line - 1].index(word) + 1) for line, word in words]


def places(lines: list[str], file: str) -> list[tuple[int, int]]:
    found = []
    for line in lines:
        match = re.match(re.escape(file) + r":(\d+):(\d+): (?!warning: )(.+); (.+)$", line)
        if match:
            found.append((int(match[1]), int(match[2])))
    return found


@pytest.mark.parametrize(("text", "words"), [(TEN_MISTAKES, TEN), (CROSSED, CROSSED_TEN)])
def test_every_mistake_of_a_file_is_one_line_with_its_place(dxlrun, tmp_path, text, words):
    file = tmp_path / "robot.yaml"
    file.write_text(text)

    said = dxlrun("check", file)

    assert said.code == 2
    assert said.out == ""
    assert sorted(places(said.errors, str(file))) == marked(text, words)


def test_a_run_refuses_the_same_file_before_any_port_is_opened(dxlrun, tmp_path, monkeypatch):
    file = tmp_path / "robot.yaml"
    file.write_text(CROSSED)

    def never(*_: object):
        raise AssertionError("a wrong file must not be run")

    monkeypatch.setattr("dxlrun.run.supervisor.run_robot", never)

    said = dxlrun(file)

    assert said.code == 2
    assert sorted(places(said.errors, str(file))) == marked(CROSSED, CROSSED_TEN)


def test_errors_as_json(dxlrun, tmp_path):
    file = tmp_path / "robot.yaml"
    file.write_text(CROSSED)

    said = dxlrun("check", file, "--json")

    errors = read_answer(said.out).errors
    assert (said.code, said.err) == (2, "")
    assert sorted((e.line, e.column) for e in errors) == marked(CROSSED, CROSSED_TEN)
    assert all(e.what and e.fix and e.file == str(file) for e in errors)


def test_the_torso_as_tables(dxlrun, torso, three_parts):
    said = dxlrun("check", torso, "port:=/dev/ttyUSB0", "--play", three_parts)

    assert said.code == 0
    assert said.out.startswith("bioloid_torso: good. 8 joints, 4 of 7 controllers active, 50 Hz, 1 warning\n")
    (row,) = [line.split() for line in said.out.splitlines() if "right_shoulder_lateral_joint  main" in line]
    assert row[2:9] == ["AX-12A", "position", "2", "240", "+1", "-180..+60", "-240..+60"]
    (bus,) = [line for line in said.out.splitlines() if "/dev/ttyUSB0" in line]
    assert "14.1 ms" in bus
    assert "71 Hz" in bus
    assert "70%" in bus
    (warning,) = said.errors
    assert warning.startswith(f"{torso}:")
    assert "right_shoulder_lateral_joint is not a mirror image of left_shoulder_lateral_joint" in warning


def test_the_torso_as_json(dxlrun, torso, three_parts):
    said = dxlrun("check", torso, "port:=/dev/ttyUSB0", "--play", three_parts, "--json")

    answer = read_answer(said.out)
    result = answer.result
    assert (said.code, said.err) == (0, "")
    assert set(result) == {
        *("robot", "rate"),
        *(
            "joints",
            "devices",
            "sensors",
            "controllers",
            "buses",
            "policies",
            "motions",
            "groups",
            "graph",
            "duration",
        ),
    }
    assert len(answer.warnings) == 1
    assert len(result["joints"]) == 8
    (bus,) = result["buses"]
    # protocol.md, Time budget: 8 reads of 6 bytes and one sync write
    assert bus["total"] == pytest.approx(14.08e-3)
    assert bus["wire"] == pytest.approx(2.08e-3)
    assert bus["highest_rate"] == pytest.approx(71.02, abs=0.01)
    assert [m["controller"] for m in result["motions"]] == ["head", "right_arm", "left_arm"]
    assert result["duration"] == 35.0


def test_too_fast_a_loop_names_the_highest_rate(dxlrun, torso):
    said = dxlrun("check", torso, "port:=/dev/ttyUSB0", "rate:=100")

    assert said.code == 2
    assert "lower the rate to at most 71 Hz" in said.errors[0]
    assert "(argument rate:=100)" in said.errors[0]


def test_a_simulated_adapter_does_not_wait(dxlrun, torso):
    (bus,) = result_of(dxlrun("check", torso, "--json").out)["buses"]

    assert bus["latency"] == 0
    assert bus["total"] == pytest.approx(6.08e-3)


def test_a_wheel_has_no_limits_and_starts_in_velocity_mode(dxlrun, torso):
    said = dxlrun("check", torso.with_name("diff_drive.yaml"))

    assert said.code == 0
    (row,) = [line.split() for line in said.out.splitlines() if "left_wheel" in line and "XL430" in line]
    assert row[3:4] == ["velocity"]
    assert row[7:11] == ["none", "continuous", "343.77/s"]
