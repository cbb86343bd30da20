"""`dxlrun check ROBOT --online` on virtual time, judged by the simulated bus' ledger."""

import pytest
from tests.kit.answers import result_of

from dxlrun.cli import main
from dxlrun.log.log_reader import read_log
from dxlsim.simulation_plan import BusConfig, ServoConfig
from dxlwire.packets import PacketKind

ROBOT = """\
name: pair
arguments:
  wrist_led: {default: 1}
buses:
  main: {port: PORT, protocol: 2.0, baud_rate: 1_000_000, adapter: {latency: 0 ms}, return_delay_time: 0 us}
loop: {rate: 50}
joints:
  elbow:
    {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1, registers: {REGISTERS}}
  wrist: {bus: main, id: 2, model: auto, reference: 180 deg, direction: 1, registers: {led: "${wrist_led}"}}
"""


@pytest.fixture
def check(virtual_lines, tmp_path, capsys):
    """Run the command on two simulated servos; gives exit code, both outputs, and what the bus was sent."""

    def check(registers, *words, ids=(1, 2), robot_text=ROBOT, before=()):
        servos = tuple(ServoConfig(servo_id, "XM430-W350", 3.0, 0) for servo_id in ids)
        path, finish = virtual_lines.serve(BusConfig("main", 1_000_000, servos, 2.0))
        assert not before or main(["servo", path, *before, "--protocol", "2.0", "--baud", "1000000"]) == 0
        robot = tmp_path / "robot.yaml"
        robot.write_text(robot_text.replace("PORT", path).replace("REGISTERS", registers))
        code = main(["check", str(robot), "--online", *words])
        said = capsys.readouterr()
        return code, said.out, said.err, [entry.data for entry in finish() if entry.direction == "in"]

    return check


def asked(sent):
    """Return which instructions were sent: 1 is ping, 2 read."""
    return {packet[7] for packet in sent}


def test_the_difference_is_a_table_and_nothing_is_written(check):
    code, out, err, sent = check("position_p_gain: 900, return_delay_time: 0 us", "--debug")
    table = [line.split() for line in out[out.index("Registers") :].splitlines()]
    assert out.startswith("pair: the servos differ from the file. 2 joints")
    assert ["elbow", "return_delay_time", "EEPROM", "9", "0", "0", "leave", "it"] in table
    assert ["elbow", "position_p_gain", "RAM", "84", "900", "800", "write", "it"] in table
    assert ["wrist", "led", "RAM", "65", "1", "0", "write", "it"] in table
    assert "2 servos compared with the file, 2 differences\n" in out
    assert (code, err) == (1, "")
    assert asked(sent) == {1, 2}


def test_servos_that_are_as_declared_are_counted(check):
    code, out, err, _ = check("position_p_gain: 800", "wrist_led:=0")
    assert "2 servos compared with the file, no differences\n" in out
    assert out.startswith("pair: good. 2 joints")
    assert (code, err) == (0, "")


def test_robot_whose_servos_do_not_answer_is_not_good(check):
    code, out, err, _ = check(
        "position_p_gain: 800", ids=(3,), robot_text=ROBOT.replace("auto", "XM430-W350")
    )
    assert (code, out.split(". ")[0]) == (1, "pair: a run would not start")
    assert "no servo compared with the file; a run would not start\n" in out
    assert "none of the 2 servos on bus main answers" in err


def test_each_servo_of_a_joint_is_counted(check):
    wrist = ROBOT.splitlines()[-1]
    two = ROBOT.replace(f"{wrist}\n", "").replace("id: 1, ", "servos: [{id: 1}, {id: 2}], ")
    _, out, err, _ = check("position_p_gain: 800", robot_text=two)
    assert "2 servos compared with the file, no differences\n" in out, err


@pytest.mark.parametrize(("limit", "tighter"), [("4 A", True), ("0.9 A", False)])
def test_a_register_that_is_tighter_than_the_file_is_reported(check, limit, tighter):
    written = ROBOT.replace("registers: {REG", f"limits: {{effort: {limit}}}, registers: {{REG")
    before = ("1", "set", "current_limit", "400", "--yes")
    code, _, err, _ = check("position_p_gain: 800", "wrist_led:=0", robot_text=written, before=before)
    sentence = (
        "elbow: goals of effort are held to Current Limit (38) = 400, 1.08 A, tighter than `limits.effort`"
    )
    assert (code, sentence in " ".join(err.split())) == (0, tighter), err


def test_a_servo_that_is_missing_is_named_and_the_table_is_there_all_the_same(check):
    code, out, _, sent = check("position_p_gain: 800", "--json", ids=(2,))
    online = result_of(out)["online"]
    assert code == 1
    assert [(row["joint"], row["found"], row["action"]) for row in online["registers"]] == [
        ("elbow", None, ""),
        ("wrist", 0, ""),
    ]
    assert online["problems"][0].startswith("elbow (ID 1 on bus main) does not answer")
    assert not online["as_declared"]
    assert online["compared"] == 1
    assert asked(sent) == {1, 2}


def test_a_robot_that_only_lives_in_simulation_has_nobody_to_look_at(tmp_path, capsys):
    robot = tmp_path / "robot.yaml"
    robot.write_text(
        ROBOT.replace("PORT", "sim").replace("REGISTERS", "led: 1").replace("auto", "XM430-W350")
    )
    assert main(["check", str(robot), "--online"]) == 2
    assert "all buses of pair are simulated" in capsys.readouterr().err


def test_its_packets_are_a_log_when_one_is_named(check, tmp_path, capsys):
    """Of the second bus, and of `model: auto`, which is asked before the robot is compiled."""
    log = tmp_path / "check.mcap"
    two = ROBOT.replace("buses:\n", "buses:\n  other: {port: sim, protocol: 2.0, baud_rate: 1_000_000}\n")
    two += "  hand: {bus: other, id: 3, model: XM430-W350, reference: 180 deg, direction: 1}\n"
    code, _, err, sent = check("position_p_gain: 800", "--log", str(log), robot_text=two)
    assert (code, err) == (1, "")

    read = read_log(log)
    assert read.buses == ("other", "main")
    assert {packet.bus for packet in read.packets} == {1}
    asked_for = b"".join(one.data for one in read.packets if one.kind == PacketKind.INSTRUCTION)
    assert asked_for == b"".join(sent)
    assert sum(one.kind == PacketKind.STATUS for one in read.packets) >= 4
    assert read.complete
    assert main(["analyze", str(log)]) == 0
    assert "--online`, not a run" in capsys.readouterr().out
    before = log.read_bytes()
    code, _, err, sent = check("position_p_gain: 800", "--log", str(log), robot_text=two)
    assert (code, sent, log.read_bytes()) == (2, [], before)
    assert "cannot be written (it exists)" in err


def test_a_log_without_online_is_refused(tmp_path, capsys):
    assert main(["check", "robot.yaml", "--log", str(tmp_path / "x.mcap")]) == 2
    assert "--log records the packets of --online; add --online" in capsys.readouterr().err


def test_settings_that_another_program_left_are_a_table_with_what_they_do(check):
    before = ("1", "set", "pwm_limit", "400", "--yes")
    code, out, err, _ = check("position_p_gain: 800", "wrist_led:=0", "--debug", before=before)
    table = [line.split() for line in out[out.index("Settings that differ") :].splitlines()]
    assert any(row[:1] == ["elbow"] and "pwm_limit" in row for row in table), out
    assert "limits the PWM" in out
    assert "1 difference\n" in out
    assert (code, err) == (0, "")
    _, out, _, _ = check("position_p_gain: 800", "wrist_led:=0", "--json", before=before)
    (found,) = result_of(out[out.index("{") :])["online"]["deviations"]
    assert (found["item"], found["found"], found["factory"]) == ("pwm_limit", 400, 885)
