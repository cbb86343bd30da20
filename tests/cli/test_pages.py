"""The commands, files and programs of pages do what the pages have.

Where a page names hardware, the command gets a simulated line instead; a run gets virtual time.
"""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.kit.awaited import DEADLINE_S
from tests.kit.commands import Dxlrun
from tests.kit.pages import page_blocks, page_commands, page_text
from tests.kit.rigs import VirtualLines
from tests.kit.virtual_run import VirtualRun

import dxlrun as face
from dxlrun import RemoteRobot
from dxlrun.channels.commands import CommandMessage
from dxlrun.cli.sim import sim
from dxlrun.cli.steering.written import WrittenEntry
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.description.joints.joint_forms import Joint
from dxlrun.description.reading import read_robot
from dxlrun.run.run_summary import RunOptions, RunSummary
from dxlrun.run.simulation_front import SimulationResult
from dxlrun.testing import plan_of, read_log, simulated_robot
from dxlrun.tooling.runs import VirtualLink
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.kinds import KINDS
from dxlsim.faults.script import FaultScript
from dxlsim.messages import SimulationJob, SimulationMessage
from dxlsim.simulation_plan import BusConfig, DeviceConfig, ServoConfig, SimulationConfig
from dxlwire.control_table import find_table

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
NEW = ("--protocol", "2.0", "--baud", "1000000")
ROBOT = """\
name: board_of_the_page
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {latency: 0 ms}}}
loop: {rate: 50}
joints: {neck: {bus: main, id: 1, model: XL430-W250, reference: 180 deg, direction: 1}}
"""
GOAL = find_table("XL330-M288").items["goal_position"].address
Line = Callable[[BusConfig], tuple[str, Callable[[], Any]]]


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> list[BusConfig]:
    """What `dxlrun sim` was about to serve."""
    buses: list[BusConfig] = []

    def serve(job: SimulationJob, *_: object, **__: object) -> SimulationResult:
        config: SimulationConfig = job.config
        buses.extend(config.buses)
        return SimulationResult(1.0, SimulationMessage(), ())

    monkeypatch.setattr(sim, "_serve", serve)
    return buses


def typed(dxlrun: Dxlrun, words: list[str]) -> str:
    """Run a command of a page and return what it prints."""
    said = dxlrun(*words)
    assert said.code == 0, (words, said)
    return said.out


def test_commands_that_need_nothing_else(dxlrun: Dxlrun, reader: Path) -> None:
    lines = page_commands("models.md") + page_commands("frames.md")
    assert len(lines) == 8
    for words in lines:
        assert typed(dxlrun, words)
    for code in page_blocks("frames.md", "python"):
        exec(compile(code, "frames.md", "exec"), {})  # noqa: S102  our own page


@pytest.mark.needs("report")
def test_analyze_md(dxlrun: Dxlrun, reader: Path) -> None:
    for _ in range(2):
        typed(dxlrun, ["robots/single_joint.yaml", "--virtual", "--duration", "0.5"])
    logs = sorted(str(path) for path in (reader / "logs").glob("*.mcap"))
    lines = page_commands("analyze.md")
    assert len(lines) == 4
    for words in lines:
        typed(
            dxlrun,
            [one for word in words for one in {"LOG": logs[:1], "logs/*.mcap": logs}.get(word, [word])],
        )
    assert (reader / "run.html").exists()


def test_raspberry_pi_md_needs_no_hardware(dxlrun: Dxlrun, reader: Path) -> None:
    """Its command `latency`, and those of real-time.md: tests/cli/test_latency.py."""
    run, doctor, _ = page_commands("raspberry-pi.md")
    assert "bioloid_torso: done" in typed(dxlrun, [*run[:-1], "0.2"])
    assert doctor == ["doctor"]


def test_mechanics_md(dxlrun: Dxlrun, reader: Path) -> None:
    check, run = page_commands("mechanics.md")
    assert "62.8 mm a turn" in typed(dxlrun, check)
    typed(dxlrun, run)
    (log,) = (reader / "logs").iterdir()
    analyzed = dxlrun("analyze", log).out
    assert re.search(r"gripper .* mm ", analyzed)
    assert re.search(r"main 2 +hip/2 ", analyzed)
    typed(dxlrun, ["convert", str(log), "again.yaml"])
    written = (reader / "again.yaml").read_text()
    assert re.search(r"gripper: \{position: 0\.0\d+ m\}", written)
    assert re.search(r"hip: \{position: -?0\.\d+ rad, velocity: -?\d\.\d+ rad/s\}", written)


def test_bus_md(
    dxlrun: Dxlrun, reader: Path, served: list[BusConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As processes: tests/cli/test_sim.py; the fault, too: tests/run/test_unplugs.py."""
    ftdi, simulate, run = page_commands("bus.md")
    refused = dxlrun(*ftdi)
    (highest,) = re.findall(r"highest rate that is left, (\d+ Hz)", page_text("bus.md"))
    assert (refused.code, highest in refused.err) == (2, True)
    (robot,) = re.findall(r"```yaml\n(name: pan_tilt.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    (reader / "robot.yaml").write_text(robot)
    typed(dxlrun, simulate)
    (bus,) = served
    assert len(bus.servos) == 2
    ports: list[str] = []

    def run_robot(plan: Any, options: RunOptions, out: object) -> RunSummary:
        ports.extend(one.port for one in plan.buses)
        return RunSummary(0, "ended", 1, 0, ())

    monkeypatch.setattr("dxlrun.run.supervisor.run_robot", run_robot)
    typed(dxlrun, run)
    assert ports == [simulate[-1]]
    (fault,) = re.findall(r"then type: (.+)$", page_text("bus.md"), re.MULTILINE)
    assert str(parse_fault(fault)) == fault


def test_simulation_md(dxlrun: Dxlrun, reader: Path, served: list[BusConfig]) -> None:
    typed(dxlrun, ["robots/single_joint.yaml", "--virtual", "--duration", "0.1"])
    (log,) = map(str, reader.glob("logs/*.mcap"))
    text = page_text("simulation.md")
    lines = [words for words in page_commands("simulation.md") if words[0] == "sim"]
    spans = re.findall(r"`dxlrun (sim --[^`]+)`", " ".join((text + page_text("tools.md")).split()))
    assert (len(lines), len(spans) > 0) == (6, True)
    for words in [*lines, *(span.split() for span in spans)]:
        typed(dxlrun, [log if word == "LOG" else word for word in words])
        assert bool(served[-1].servos) != bool(served[-1].recorded)
    rows = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \| .* \|$", text.split("## Faults")[1], re.MULTILINE)
    assert {kind for row in rows for kind in re.findall(r"`(\w+)`", row)} == set(KINDS)


def test_tools_md(dxlrun: Dxlrun, reader: Path, virtual_lines: VirtualLines) -> None:
    servo = ServoConfig(1, "XM430-W350", 2.0)
    path, finish = virtual_lines.serve(BusConfig("main", 1_000_000, (servo,), 2.0))
    scan, synopsis, *servo = page_commands("tools.md")
    assert (synopsis, len(servo)) == (["servo", "PORT", "ID", "VERB"], 3)
    found = typed(dxlrun, [scan[0], path, *scan[2:], "--baud", "1000000", "--ids", "1-9"])
    assert "XM430-W350" in found
    for words in servo:  # EEPROM is written without a question here; the rate is given, to be quick
        typed(dxlrun, [words[0], path, *words[2:], "--yes", "--baud", "1000000"])
    assert json.loads((reader / "elbow.json").read_text())["id"] == 7
    sent = [entry.data for entry in finish() if entry.direction == "in"]
    writes = {(data[4], data[8], data[10:-2]) for data in sent if data[2:3] == b"\xfd" and data[7] == 3}
    items = find_table("XM430-W350").items
    assert (1, items["return_delay_time"].address, b"\x00") in writes
    assert (1, items["id"].address, b"\x07") in writes


def test_devices_md(dxlrun: Dxlrun, reader: Path, virtual_lines: VirtualLines) -> None:
    board = DeviceConfig(200, "OpenCR")
    path, _ = virtual_lines.serve(BusConfig("main", 1_000_000, (), 2.0, devices=(board,)))
    robot = simulated_robot("robots/wolfgang.yaml")
    lines = page_commands("devices.md")
    assert len(lines) == 10
    for words in lines:
        if words[0] == "sim":
            fault = parse_fault(words[words.index("--fault") + 1])
            FaultScript([fault]).attach(robot.buses)  # refuses what could not happen
        elif "/dev/ttyUSB0" in words:
            ids = ["--ids", "200"] if words[0] == "scan" else []
            typed(dxlrun, [path if word == "/dev/ttyUSB0" else word for word in [*words, *NEW, *ids]])
        else:
            typed(dxlrun, words)
    (table,), (devices,) = page_blocks("devices.md", "toml"), page_blocks("devices.md", "yaml")
    (reader / "my_board.toml").write_text(table)
    mine = "  mine: {bus: main, id: 9, model: my_board.toml, commands: [lamp]}\n"
    (reader / "robot.yaml").write_text(f"{ROBOT}{devices}{mine}")
    loop = compile_files(reader / "robot.yaml", {}, []).plan.loop
    assert loop.source_states["mine"] == ("force.z", "button.start", "button.stop")
    assert loop.source_states["foot"] == ("toe", "heel")
    assert loop.source_commands == ("board/led", "mine/lamp")


def test_commands_md_has_what_is_printed_of_a_wrong_file(dxlrun: Dxlrun, reader: Path) -> None:
    joint = "{{bus: {}, id: {}, model: {}, reference: 150 deg, direction: 1}}"
    joints = {
        "left_joint": joint.format("main", 1, "AX-12A"),
        "neck_joint": joint.format("mian", 3, "AX-12A"),
        "back_joint": joint.format("main", 1, "AX-12A"),
        "tail_joint": joint.format("main", 4, "AX-12B"),
    }
    lines = ["name: wrong", "buses:", "  main: {port: sim, protocol: 1.0, baud_rate: 1_000_000}"]
    lines += ["loop: {rate: 50}", "joints:", *(f"  {name}: {one}" for name, one in joints.items()), ""]
    (reader / "robot.yaml").write_text("\n".join(lines))
    (shown,) = re.findall(r"```\n(robot.yaml:.*?)```", page_text("commands.md"), re.DOTALL)
    checked = dxlrun("check", "robot.yaml")
    assert (checked.code, checked.err) == (2, shown)


# Coming from other programs


def test_from_ros2_control_md(dxlrun: Dxlrun, reader: Path) -> None:
    parameters, robot, motion = page_blocks("from-ros2-control.md", "yaml")
    (reader / "arm.yaml").write_text(robot)
    (reader / "wave.yaml").write_text(motion)
    (reader / "controllers.yaml").write_text(parameters)
    check, play, run = page_commands("from-ros2-control.md")
    typed(dxlrun, check)
    typed(dxlrun, play)
    assert run == ["arm.yaml", "port:=/dev/ttyUSB0"]  # play is the same without a port
    refused = dxlrun("check", "controllers.yaml")
    assert (refused.code, "a parameter file of ROS 2 (ros2_control)" in refused.err) == (2, True)


LIBRARIES = "from-lerobot-rustypot-sdk.md"


def two_servos(simulated_line: Line) -> tuple[str, Callable[[], Any]]:
    servos = tuple(ServoConfig(each, "XL330-M288", 2.0) for each in (1, 2))
    return simulated_line(BusConfig("main", 57_600, servos, 2.0))


def test_programs_of_the_sdk_and_the_bus_move_both_servos(simulated_line: Line) -> None:
    pytest.importorskip("dynamixel_sdk", exc_type=ModuleNotFoundError)
    port, finish = two_servos(simulated_line)
    sdk, script, _ = (text.replace("/dev/ttyUSB0", port) for text in page_blocks(LIBRARIES, "python"))
    exec(sdk, {})  # noqa: S102  of this repository
    names: dict[str, Any] = {}
    exec(script, names)  # noqa: S102  of this repository
    assert len(names["positions"]) == 2
    sent = b"".join(entry.data for entry in finish() if entry.direction == "in")
    writes = re.findall(rb"\x03" + GOAL.to_bytes(2, "little") + rb"(....)", sent, re.DOTALL)
    goals = [int.from_bytes(goal, "little") for goal in writes]
    assert goals[:2] == [2048 + 114] * 2
    assert goals[-2:] == [2048 + 114] * 2  # before, torque came on where the servos were


def test_client_moves_the_arm_that_a_scan_has_drafted(
    dxlrun: Dxlrun, reader: Path, monkeypatch: pytest.MonkeyPatch, virtual_lines: VirtualLines
) -> None:
    port, _ = two_servos(virtual_lines.serve)
    simulate, scan, check, run, koch = page_commands(LIBRARIES)
    assert (simulate[:3], run) == (["sim", "--servo", "XL330-M288:1-2"], ["arm.yaml"])
    given = [port if word == "/dev/ttyUSB0" else word for word in scan]
    typed(dxlrun, [*given, "--baud", "57600", "--ids", "1-2", "--protocol", "2.0"])
    typed(dxlrun, check)
    arm = reader / "arm.yaml"
    arm.write_text(arm.read_text().replace(port, "sim"))
    link = VirtualLink(plan_of(arm))
    monkeypatch.setattr(face, "connect", lambda name: nullcontext(RemoteRobot(name, link)))
    exec(page_blocks(LIBRARIES, "python")[2], {})  # noqa: S102  of this repository
    for _ in range(200):
        link.run_cycle()
    cycles, _ = link.new()
    assert np.degrees(cycles["position"][-1]) == pytest.approx([10.0, 10.0], abs=1.0)
    typed(dxlrun, koch)


# The architecture


def test_motion_of_architecture_md_has_these_bytes_and_this_row(dxlrun: Dxlrun, tmp_path: Path) -> None:
    """The command goes the page's way, without the sockets: tests/cli/test_steer.py has those."""
    page = page_text("architecture.md")
    ((_, controller, kind, *words),) = page_commands("architecture.md")
    command, request, reply, _ = map(bytes.fromhex, re.findall(r"^(FF FF [\dA-F ]+)$", page, re.MULTILINE))
    torso = ROOT / "robots/bioloid_torso.yaml"
    robot = VirtualRun(torso, tmp_path / "torso.mcap", duration_s=4.0)
    (head,) = (one for one in robot.plan.loop.controllers if one.name == controller)
    body = json.dumps(WrittenEntry.from_words(words, None).data).encode()
    prepared = robot.door.command(head, kind, body, units=True)
    assert (len(prepared.data), prepared.beyond) == (32, ())
    sent = CommandMessage(0, controller, kind, prepared.data, "a reader")
    robot.post_at(2000, sent)
    recorded = robot.finish()
    robot.require_done()
    entries = robot.ledger.entries
    moves = [one for one in entries if one.direction == "in" and one.t_ns > 2e9 and one.data[4] == 0x83]
    assert moves[3].data == command  # in the fourth cycle; what changed in it once more
    assert moves[4].data[7:12] == command[12:17]
    (at,) = (index for index, one in enumerate(entries) if one.data == reply)
    assert entries[at - 1].data == request
    assert [packet.data for packet in recorded.packets].count(reply) == 1
    cycle = recorded.cycles[np.searchsorted(recorded.cycles["read_ns"], entries[at].t_ns)]
    row = recorded.joints.index("head_yaw_joint")
    assert f"{np.degrees(cycle['position'][row]):.1f} deg of the joint" in page
    assert f"{cycle['velocity'][row]:.2f} rad/s" in page
    assert (cycle["effort"][row], cycle["valid"][row]) == (-195 / 1023, True)
    printed = [line.split() for line in dxlrun("analyze", recorded.path).out.splitlines()]
    shown = [line.split() for line in page.splitlines() if line.startswith(("joint  ", "head_yaw_joint  "))]
    assert len(shown) == 2
    assert all(row in printed for row in shown)


def test_key_of_architecture_md_becomes_these_bytes() -> None:
    page = page_text("architecture.md")
    packet = bytes.fromhex(re.findall(r"^(FF FF [\dA-F ]+)$", page, re.MULTILINE)[-1])
    (entry,) = re.findall(
        r"`elbow_flex: \{id: (\d+), model: \S+, registers: \{position_p_gain: (\d+)\}\}`", page
    )
    described = read_robot(ROOT / "robots/koch.yaml", {}).robot.joints["elbow_flex"]
    assert isinstance(described, Joint)
    assert (described.id, described.registers["position_p_gain"]) == tuple(map(int, entry))
    robot = simulated_robot(ROOT / "robots/koch.yaml", duration_s=0.1)
    robot.run()
    written = [one.data for one in robot.ledger.entries if one.direction == "in"]
    assert written.count(packet) == 1


ARM, LIFT = ROOT / "robots/effort_arm.yaml", ROOT / "robots/motions/effort_arm_lift.yaml"
PROGRAM, _ = re.findall(r"```python\n(.*?)```", page_text("many-runs.md"), re.DOTALL)
SMALL = 'GRID = {"p": (2, 10, "high"), "d": (0.05,)}'


def test_program_ranks_the_runs_by_tracking_error(tmp_path: Path) -> None:
    (tmp_path / "robots").symlink_to(ROOT / "robots")
    small, count = re.subn(r"^GRID = .*$", SMALL, PROGRAM, flags=re.MULTILINE)
    assert count == 1
    (tmp_path / "gains.py").write_text(small)
    ran = subprocess.run(
        [sys.executable, "gains.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    refused = [line for line in ran.stdout.splitlines() if line.startswith("{")]
    assert "'p': 'high'" in refused[0]
    assert "gains.p" in ran.stdout
    heading, *rows, best = ran.stdout.splitlines()[-5:]
    assert heading.split("\t") == ["p", "d", "error (deg)"]
    assert [row.split("\t")[:2] for row in rows] == [["10", "0.05"], ["2", "0.05"], ["high", "0.05"]]
    assert float(rows[0].split("\t")[2]) == pytest.approx(shoulder_error_deg(tmp_path, "10"), rel=0.01)
    assert rows[2].endswith("\tinf")
    assert best == "best: p:=10 d:=0.05"


def shoulder_error_deg(tmp_path: Path, p: str) -> float:
    """Return the RMS tracking error from the references and positions of the cycles."""
    log = tmp_path / "judge.mcap"
    simulated_robot(ARM, arguments={"p": p, "d": "0.05"}, play=[LIFT], log=log).run()
    cycles = read_log(log).cycles
    reference, position = cycles["reference"][:, 0], cycles["position"][:, 0]
    known = np.isfinite(reference)
    return float(np.degrees(np.sqrt(np.mean((reference - position)[known] ** 2))))
