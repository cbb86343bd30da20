"""`dxlrun scan`: simulated servos, mostly on virtual time, judged by the ledger."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from tests.kit.answers import result_of
from tests.kit.bus_ports import BusPorts
from tests.kit.commands import Dxlrun
from tests.kit.mixed_line import MixedBus
from tests.kit.rigs import VirtualLine, VirtualLines

from dxlrun.cli.tools.scan import scan
from dxlrun.dynamixel.tools import tool_port
from dxlrun.log.log_reader import read_log
from dxlsim.simulation_plan import BusConfig, ServoConfig
from dxlwire.packets import PacketKind

NARROW = ("--baud", "1000000", "--ids", "1-4")
HOLD = """
import sys
from dxlwire.port.serial_open import open_serial
port = open_serial(sys.argv[1], 57_600)
print("open", flush=True)
sys.stdin.read()
"""
Line = Callable[[BusConfig], tuple[str, Callable[[], Any]]]


def bus(*models: str) -> BusConfig:
    servos = tuple(ServoConfig(number, model, 2.0) for number, model in enumerate(models, 1))
    return BusConfig("main", 1_000_000, servos, 1.0 if "AX-12A" in models else 2.0)


def heard(finish: Callable[[], Any]) -> list[bytes]:
    return [entry.data for entry in finish() if entry.direction == "in"]


def test_servos_are_a_table_a_log_and_a_robot_file_that_check_accepts(
    dxlrun: Dxlrun, virtual_lines: VirtualLines, tmp_path: Path
) -> None:
    path, finish = virtual_lines.serve(bus("XM430-W350", "XL430-W250"))
    robot, log = tmp_path / "arm.yaml", tmp_path / "scan.mcap"
    said = dxlrun("scan", path, "--protocol", "2.0", *NARROW, "--output", robot, "--log", log)
    assert (said.code, said.err) == (0, "")
    head, _, first, second, written, *_ = said.out.splitlines()
    assert head.split()[:2] == ["ID", "model"]
    assert first.split()[:2] == ["1", "XM430-W350"]
    assert second.split()[:6] == ["2", "XL430-W250", "1060", "45", "2.0", "1000000"]
    assert written.startswith(f"robot file: {robot}; complete it")
    assert yaml.safe_load(robot.read_text())["joints"]["joint_2"]["model"] == "XL430-W250"
    assert dxlrun("check", robot).code == 0
    online = dxlrun("check", robot, "--online", "--json")
    assert online.code == 0, online.out

    sent = heard(finish)
    assert {data[7] for data in sent} == {1, 2}, "pings and reads"
    read = read_log(log)
    packets = b"".join(one.data for one in read.packets if one.kind == PacketKind.INSTRUCTION)
    assert len(packets) > 100
    assert b"".join(sent).startswith(packets)
    assert (set(read.packets.cycle.tolist()), read.complete) == ({-1}, True)
    assert "runtime" in read.metadata["identity"]
    said = dxlrun("analyze", log)
    assert (said.code, said.err) == (0, "")
    assert f"traffic of `dxlrun scan {path}`, not a run: {len(read.packets)} packets" in said.out


def test_both_protocols_are_looked_at_and_reported_as_json(
    dxlrun: Dxlrun, virtual_lines: VirtualLines
) -> None:
    path, finish = virtual_lines.serve(bus("AX-12A"))
    said = dxlrun("scan", path, *NARROW, "--json")
    result = result_of(said.out)
    assert (said.code, result["port"]) == (0, path)
    (servo,) = result["servos"]
    assert (servo["model"], servo["protocol"], servo["baud_rate"]) == ("AX-12A", 1.0, 1_000_000)
    packets = b"".join(heard(finish)).split(b"\xff\xff")[1:]  # not by entry: a delayed bus hears two at once
    assert {data[2] for data in packets if data[0] != 0xFD} == {1, 2}
    assert sum(data[0] == 0xFD for data in packets) >= 4


def test_both_protocols_are_found_on_one_line_with_a_warning(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A status of the XL430, at -16 ticks, is the beginning of 258 bytes for the AX-12A."""
    line: Any = VirtualLine(rate=1_000_000)
    line.bus = MixedBus([ServoConfig(1, "AX-12A", 2.0), ServoConfig(2, "XL430-W250", 2.0)], line.ledger)
    line.ports = BusPorts(line.clock, [line.bus])
    line.bus.servo(2).show_live({"present_position": lambda: -16})
    monkeypatch.setattr(tool_port, "TunablePort", lambda path: line)
    assert scan("/dev/ttyUSB0", baud=(1_000_000,), ids="1-8", as_json=True) == 0
    said = capsys.readouterr().out
    found = [(servo["servo_id"], servo["protocol"]) for servo in result_of(said)["servos"]]
    assert found == [(2, 2.0), (1, 1.0)]
    assert "/dev/ttyUSB0 has servos of both protocols: give each protocol an adapter of its own" in said


def test_no_servo_at_all_is_exit_code_one(dxlrun: Dxlrun, virtual_lines: VirtualLines) -> None:
    path, _ = virtual_lines.serve(bus())
    said = dxlrun("scan", path, *NARROW)
    assert (said.code, f"no servo answers at {path}" in said.err) == (1, True)


def test_port_in_use_is_not_touched_and_its_process_is_named(dxlrun: Dxlrun, simulated_line: Line) -> None:
    path, finish = simulated_line(bus("XM430-W350"))
    command = [sys.executable, "-c", HOLD, path]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout
        assert other.stdout.readline() == "open\n"
        said = dxlrun("scan", path, *NARROW)
        other.communicate()
    assert said.code == 1
    assert f"{path} is in use by" in said.err
    assert f"(process {other.pid})" in said.err
    assert heard(finish) == []
