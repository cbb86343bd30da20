"""`dxlrun scan`: its words, and a pseudo-terminal with simulated servos, judged by the ledger."""

import subprocess
import sys

import yaml
from tests.kit.answers import result_of

from dxlrun.log.log_reader import read_log
from dxlsim.simulation_plan import BusConfig, ServoConfig
from dxlwire.packets import PacketKind


def servos(*models):
    return tuple(ServoConfig(number + 1, model, 2.0) for number, model in enumerate(models))


NARROW = ("--baud", "1000000", "--ids", "1-4")


def test_the_servos_are_a_table_and_a_robot_file_that_check_accepts(dxlrun, simulated_line, tmp_path):
    path, finish = simulated_line(BusConfig("main", 1_000_000, servos("XM430-W350", "XL430-W250"), 2.0))
    robot = tmp_path / "arm.yaml"
    said = dxlrun("scan", path, "--protocol", "2.0", *NARROW, "--output", robot)
    assert (said.code, said.err) == (0, "")
    head, _, first, second, written = said.out.splitlines()
    assert head.split()[:2] == ["ID", "model"]
    assert first.split()[:2] == ["1", "XM430-W350"]
    assert second.split()[:6] == ["2", "XL430-W250", "1060", "45", "2.0", "1000000"]
    assert written.startswith(f"robot file: {robot}; complete it")
    assert yaml.safe_load(robot.read_text())["joints"]["joint_2"]["model"] == "XL430-W250"
    assert dxlrun("check", robot).code == 0
    online = dxlrun("check", robot, "--online", "--json")
    assert online.code == 0, online.out
    assert {entry.data[7] for entry in finish() if entry.direction == "in"} == {1, 2}


def test_both_protocols_are_looked_at_and_told_as_json(dxlrun, simulated_line):
    path, finish = simulated_line(BusConfig("main", 1_000_000, servos("AX-12A")))
    said = dxlrun("scan", path, *NARROW, "--json")
    assert said.code == 0
    result = result_of(said.out)
    assert result["port"] == path
    (servo,) = result["servos"]
    assert (servo["model"], servo["protocol"], servo["baud_rate"]) == ("AX-12A", 1.0, 1_000_000)
    heard = b"".join(entry.data for entry in finish() if entry.direction == "in")
    packets = heard.split(b"\xff\xff")[1:]  # not by entry: a bus that stood still hears two at once
    assert {data[2] for data in packets if data[0] != 0xFD} == {1, 2}
    assert sum(data[0] == 0xFD for data in packets) >= 4


def test_no_servo_at_all_is_exit_code_one(dxlrun, simulated_line):
    path, _ = simulated_line(BusConfig("main", 1_000_000, (), 2.0))
    said = dxlrun("scan", path, *NARROW)
    assert said.code == 1
    assert f"no servo answers at {path}" in said.err


HOLD = """
import sys
from dxlwire.port.serial_open import open_serial
port = open_serial(sys.argv[1], 57_600)
print("open", flush=True)
sys.stdin.read()
"""


def test_a_port_in_use_is_not_touched_and_its_process_is_named(dxlrun, simulated_line):
    path, finish = simulated_line(BusConfig("main", 1_000_000, servos("XM430-W350"), 2.0))
    command = [sys.executable, "-c", HOLD, path]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "open\n"
        said = dxlrun("scan", path, *NARROW)
        other.stdin.close()
    assert said.code == 1
    assert f"{path} is in use by" in said.err
    assert f"(process {other.pid})" in said.err
    assert [entry for entry in finish() if entry.direction == "in"] == []


def test_the_packets_of_a_scan_are_a_log_when_it_is_named(dxlrun, simulated_line, tmp_path):
    path, finish = simulated_line(BusConfig("main", 1_000_000, servos("XM430-W350"), 2.0))
    log = tmp_path / "scan.mcap"
    assert dxlrun("scan", path, "--protocol", "2.0", *NARROW, "--log", log).code == 0

    read = read_log(log)
    sent = b"".join(one.data for one in read.packets if one.kind == PacketKind.INSTRUCTION)
    assert sent == b"".join(entry.data for entry in finish() if entry.direction == "in")
    assert set(read.packets.cycle.tolist()) == {-1}
    assert read.complete
    assert "runtime" in read.metadata["identity"]
    said = dxlrun("analyze", log)
    assert (said.code, said.err) == (0, "")
    assert f"traffic of `dxlrun scan {path}`, not a run: {len(read.packets)} packets" in said.out
