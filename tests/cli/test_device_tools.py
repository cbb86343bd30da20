"""`dxlrun scan` and `dxlrun servo` with boards on the line, judged by the simulated bus' ledger."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from tests.kit.answers import result_of
from tests.kit.pages import page_text

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.testing import simulated_robot
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript
from dxlsim.simulation_plan import BusConfig, DeviceConfig, ServoConfig

pytestmark = pytest.mark.long

NEW = ("--protocol", "2.0", "--baud", "1000000")
OLD = ("--protocol", "1.0", "--baud", "1000000")
BOARDS = BusConfig(
    "main",
    1_000_000,
    (ServoConfig(1, "XL430-W250", 3.0),),
    2.0,
    devices=(
        DeviceConfig(42, "bitbots-core"),
        DeviceConfig(241, "bitbots-imu"),
        DeviceConfig(101, "bitbots-foot"),
    ),
)


def test_a_scan_finds_boards_beside_servos_and_drafts_them(dxlrun, simulated_line, tmp_path):
    path, finish = simulated_line(BOARDS)
    said = dxlrun("scan", path, *NEW, "--output", tmp_path / "found.yaml", "--json")
    assert said.code == 0, said.err
    found = {each["servo_id"]: each for each in result_of(said.out)["servos"]}
    assert {key: (each["model"], each["device"]) for key, each in found.items()} == {
        1: ("XL430-W250", False),
        42: ("bitbots-core", True),
        101: ("", False),
        241: ("bitbots-imu", True),
    }
    assert "no control table has its model number 0" in found[101]["remarks"][0]
    plan = compile_files(tmp_path / "found.yaml", {}, []).plan
    assert [(each.name, each.model) for each in plan.buses[0].devices] == [
        ("device_42", "bitbots-core"),
        ("device_241", "bitbots-imu"),
    ]
    sent = [entry.data for entry in finish() if entry.direction == "in"]
    assert {data[7] for data in sent} == {1, 2}, "pings and reads: nothing is written"


def test_items_of_a_board_are_read_and_written(dxlrun, simulated_line):
    path, finish = simulated_line(BOARDS)
    said = dxlrun("servo", path, 241, "get", "accel_z", "button_1", *NEW)
    assert "9.80665 m/s^2" in said.out, said.err
    shown = result_of(dxlrun("servo", path, 42, "get", "--json", *NEW).out)
    assert (shown["registers"]["vdxl"], shown["servo"]["model"]) == (574, "bitbots-core")
    assert (
        "LED 0 Red (10) was changed from 0 to 200"
        in dxlrun("servo", path, 42, "set", "led_0_red", 200, *NEW).out
    )
    assert "LED 0 Red (10) is 200 already" in dxlrun("servo", path, 42, "set", "led_0_red", 200, *NEW).out
    said = dxlrun("servo", path, 241, "set", "accel_gain", "0.25", "--yes", *NEW)
    assert said.code == 0, said.err
    assert "0.25" in dxlrun("servo", path, 241, "get", "accel_gain", *NEW).out
    writes = [entry.data for entry in finish() if entry.direction == "in" and entry.data[7] == 3]
    assert [(data[4], data[8:-2]) for data in writes] == [
        (42, bytes.fromhex("0a00c8")),
        (241, bytes.fromhex("6e00 0000803e")),
    ]


PAGE = page_text("devices.md")
ROBOT = """\
name: board_of_the_page
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {latency: 0 ms}}}
loop: {rate: 50}
joints: {neck: {bus: main, id: 1, model: XL430-W250, reference: 180 deg, direction: 1}}
"""
WRONG = (
    (
        (42, "reboot"),
        "bitbots-core, ID 42 at 1000000 bit/s is not a servo and cannot reboot; use get",
    ),
    ((42, "set", "vdxl", 3), "Vdxl (32) can only be read"),
    ((42, "set", "led", 2), "LED (22) of an bitbots-core is 0..1, not 2"),
    ((42, "set", "id", 9), "dxlrun does not set id of a device"),
    ((42, "get", "vbatt"), "has no vbatt"),
    ((241, "set", "accel_gain", "much"), "'much' is not a number; Accel Gain (110) is a float32"),
    ((241, "set", "gyro_range", 2), "not a terminal, cannot ask for confirmation"),
)


def test_what_a_board_cannot_do_is_one_sentence(dxlrun, simulated_line):
    path, finish = simulated_line(BOARDS)
    for words, sentence in WRONG:
        said = dxlrun("servo", path, *words, *NEW)
        assert (said.code, len(said.errors)) == (2, 1), said.err
        assert sentence in said.err
    assert not [entry for entry in finish() if entry.direction == "in" and entry.data[7] == 3]


def test_boards_of_protocol_1_are_found(dxlrun, simulated_line):
    config = BusConfig(
        "main", 1_000_000, (ServoConfig(1, "MX-28", 3.0),), 1.0, devices=(DeviceConfig(200, "CM-730"),)
    )
    path, _ = simulated_line(config)
    said = dxlrun("scan", path, *OLD, "--ids", "1,200", "--json")
    assert [(each["servo_id"], each["model"]) for each in result_of(said.out)["servos"]] == [
        (1, "MX-28"),
        (200, "CM-730"),
    ]
    assert (
        "Dynamixel Power (24) was changed from 0 to 1"
        in dxlrun("servo", path, 200, "set", "dynamixel_power", 1, *OLD).out
    )


def test_the_commands_of_the_page_work(dxlrun, simulated_line, tmp_path, monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[2])
    lines = re.findall(r"^    (dxlrun .+)$", PAGE, re.MULTILINE)
    board = BusConfig("main", 1_000_000, (), 2.0, devices=(DeviceConfig(200, "OpenCR"),))
    path, _ = simulated_line(board)
    robot = simulated_robot("robots/wolfgang.yaml")
    for line in lines:
        words = shlex.split(line)[1:]
        if words[0] == "sim":
            fault = parse_fault(words[words.index("--fault") + 1])
            FaultScript([fault]).attach(robot.buses)  # refuses what could not happen
            continue
        if "/dev/ttyUSB0" in line:
            words = [path if word == "/dev/ttyUSB0" else word for word in words] + [*NEW]
            words += ["--ids", "200"] if words[0] == "scan" else []
        said = dxlrun(*words, *(["--no-record"] if words[0].startswith("robots/") else []))
        assert (said.code, said.err) == (0, ""), line
    assert len(lines) == 10


def test_the_board_and_the_robot_of_the_page_are_accepted(tmp_path):
    (table,) = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    (devices,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    (tmp_path / "my_board.toml").write_text(table)
    path = tmp_path / "robot.yaml"
    path.write_text(f"{ROBOT}{devices}  mine: {{bus: main, id: 9, model: my_board.toml, commands: [lamp]}}\n")
    plan = compile_files(path, {}, []).plan
    assert plan.loop.source_states["mine"] == ("force.z", "button.start", "button.stop")
    assert plan.loop.source_states["foot"] == ("toe", "heel")
    assert plan.loop.source_commands == ("board/led", "mine/lamp")
