"""`dxlrun check ROBOT --online` on pseudo-terminals, judged by the simulated bus' ledger."""

import json

import pytest

from dxlrun.cli import main
from dxlrun.simulation import BusConfig, ServoConfig

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
def check(simulated_line, tmp_path, capsys):
    """Run the command on two simulated servos; gives exit code, both outputs, and what the bus was sent."""

    def check(registers, *words, ids=(1, 2)):
        servos = tuple(ServoConfig(servo_id, "XM430-W350", 3.0, 0) for servo_id in ids)
        path, finish = simulated_line(BusConfig("main", 1_000_000, servos, 2.0))
        robot = tmp_path / "robot.yaml"
        robot.write_text(ROBOT.replace("PORT", path).replace("REGISTERS", registers))
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
    assert ["elbow", "return_delay_time", "EEPROM", "9", "0", "0", "leave", "it"] in table
    assert ["elbow", "position_p_gain", "RAM", "84", "900", "800", "write", "it"] in table
    assert ["wrist", "led", "RAM", "65", "1", "0", "write", "it"] in table
    assert "2 servos compared with the file, 2 differences\n" in out
    assert (code, err) == (1, "")
    assert asked(sent) == {1, 2}


def test_servos_that_are_as_declared_are_counted(check):
    code, out, err, _ = check("position_p_gain: 800", "wrist_led:=0")
    assert "2 servos compared with the file, no differences\n" in out
    assert (code, err) == (0, "")


def test_a_servo_that_is_missing_is_not_counted(check):
    code, out, _, _ = check("position_p_gain: 800", ids=(2,))
    assert "1 servo compared with the file, 1 difference; a run would not start\n" in out
    assert code == 1


def test_a_servo_that_is_missing_is_named_and_the_table_is_there_all_the_same(check):
    code, out, _, sent = check("position_p_gain: 800", "--json", ids=(2,))
    online = json.loads(out)["online"]
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
    assert "every bus of pair is simulated" in capsys.readouterr().err
