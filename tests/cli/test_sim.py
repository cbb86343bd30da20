"""`dxlrun sim` as a person uses it: started, talked to by other programs, stopped."""

import contextlib
import json
import os
import re
import resource
import select
import signal
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.kit.answers import read_answer, result_of
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.hands import Screen, plain
from tests.kit.pages import page_blocks, page_text
from tests.kit.torso import copy_robots

from dxlsim.bus.ledger import read_ledger

pytestmark = pytest.mark.long

PROGRAM = [sys.executable, "-P", "-m", "dxlrun"]
PING_1 = bytes.fromhex("ff ff fd 00 01 03 00 01 19 4e")
PONG_1 = bytes.fromhex("ff ff fd 00 01 07 00 55 00 24 04 2d")
"""A ping of servo 1 (e-Manual, Protocol 2.0, Ping), and the first bytes of the answer of an XL430-W250."""
PING_2 = bytes.fromhex("ff ff fd 00 02 03 00 01 19 72")
OLD_PING, OLD_PONG = bytes.fromhex("ff ff 01 02 01 fb"), bytes.fromhex("ff ff 01 02 00 fc")
TWO = """
name: two_buses
buses:
  left: {port: /dev/ttyUSB0, protocol: 2.0, baud_rate: 1_000_000, adapter: {latency: 1 ms}}
  right: {port: /dev/ttyUSB1, protocol: 1.0, baud_rate: 1_000_000, adapter: {latency: 1 ms}}
loop: {rate: 20}
joints:
  left_joint: {bus: left, id: 1, model: XL430-W250, reference: 180 deg, direction: 1}
  right_joint: {bus: right, id: 1, model: AX-12A, reference: 150 deg, direction: 1}
controllers:
  joint_state_broadcaster: {type: joint_state_broadcaster}
"""


class Sim:
    """A simulation that was started from a command line."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdin is not None
        assert process.stdout is not None
        self.process = process
        self.input, self._out = process.stdin, process.stdout
        self._said = b""

    def line(self) -> str:
        """Return the next line that it says."""
        while b"\n" not in self._said:
            assert select.select([self._out], [], [], DEADLINE_S)[0], f"it says no more after {self._said!r}"
            piece = os.read(self._out.fileno(), 65536)
            assert piece, self.process.communicate()[1]
            self._said += piece
        line, _, self._said = self._said.partition(b"\n")
        return line.decode()

    def result(self) -> Any:
        return result_of(self.line())

    def type(self, line: str) -> None:
        self.input.write(line.encode() + b"\n")
        self.input.flush()

    def end(self) -> tuple[int, str, str]:
        """Return exit code, what was not read yet, and the errors, when it has ended."""
        out, err = self.process.communicate(timeout=DEADLINE_S)
        return self.process.returncode, (self._said + out).decode(), err.decode()

    def stop(self, number: signal.Signals = signal.SIGINT) -> tuple[int, str, str]:
        self.process.send_signal(number)
        return self.end()

    @property
    def child(self) -> int:
        """The process of the simulated bus."""
        pid = self.process.pid
        return int(Path(f"/proc/{pid}/task/{pid}/children").read_text().split()[0])


Start = Callable[..., Sim]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    pipe = subprocess.PIPE
    with contextlib.ExitStack() as stack:

        def start(*words: object) -> Sim:
            command = [*PROGRAM, "sim", *map(str, words)]
            process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, cwd=tmp_path)
            stack.enter_context(process)
            stack.callback(process.kill)
            return Sim(process)

        yield start


def hear(path: Path | str, ask: bytes, size: int) -> bytes:
    """Open a port as any program would, ask, and return what comes."""
    port = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        os.write(port, ask)
        heard = b""
        while len(heard) < size:
            assert select.select([port], [], [], DEADLINE_S)[0], f"only {heard.hex(' ')} came"
            heard += os.read(port, 256)
        return heard
    finally:
        os.close(port)


def test_robot_runs_against_it_as_against_a_real_one(start: Start, tmp_path: Path) -> None:
    copy_robots(tmp_path)
    torso = tmp_path / "robots/bioloid_torso.yaml"
    sim = start(torso, "--link", "torso", "--ledger", "ledger.jsonl")
    assert sim.line() == (
        "bioloid_torso: 8 servos simulated on 1 bus; Ctrl-C ends it, `help` lists faults to type"
    )
    bus = r"  main: .*/torso \(/dev/pts/\d+\), 1000000 bit/s, Protocol 1.0, AX-12A 1-6, 20-21$"
    assert re.match(bus, sim.line())
    assert sim.line().startswith("  in real time: ")
    hint = sim.line()
    assert hint == f"next: dxlrun {torso} port:={tmp_path / 'torso'}"
    command = [*PROGRAM, *hint.split()[2:], "rate:=5", "--duration", "0.5", "--no-record"]
    ran = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "bioloid_torso: " in ran.stdout
    code, out, err = sim.stop()

    assert code == 0, err
    counts = re.search(r"bioloid_torso: ended after [\d.]+ s\. (\d+) packets received, (\d+) answered", out)
    assert counts is not None
    heard, answered = map(int, counts.groups())
    assert heard > answered > 100  # a sync write is heard by each and answered by none
    assert out.splitlines()[-1] == "ledger: ledger.jsonl"
    assert not os.path.lexists(tmp_path / "torso")
    asked = [entry for entry in read_ledger(tmp_path / "ledger.jsonl") if entry.direction == "in"]
    assert len(asked) > 100


def test_servos_without_a_robot_file_answer_and_take_planned_and_typed_faults(
    start: Start, tmp_path: Path
) -> None:
    planned = "overload servo=1 packet=2"
    words = ("--fault", "lose servo=1", "--fault", planned, "--ledger", "ledger.jsonl")
    sim = start("--servo", "XL430-W250:1-2", "--json", *words)
    port = sim.result()["ports"]["main"]
    assert hear(port, PING_1 + PING_1, 14)[:12] == PONG_1  # the first is lost
    assert [sim.result(), sim.result()] == [{"fault": "lose servo=1"}, {"fault": planned}]
    sim.type("silence  servo=0x1")
    assert sim.result() == {"understood": "silence servo=1"}
    assert sim.result() == {"fault": "silence servo=1"}
    sim.type("slience servo=1")
    assert "did you mean silence?" in read_answer(sim.line()).errors[0].fix
    sim.type("help")
    assert any(line.startswith("lose ") for line in sim.result()["faults"])

    sim.input.close()  # no more input: that ends nothing
    sim.process.stdin = None
    assert hear(port, PING_2, 14)[:5] == PING_2[:5]
    assert sim.stop(signal.SIGTERM) == (0, "", "")
    notes = [entry.note for entry in read_ledger(tmp_path / "ledger.jsonl")]
    faults = [note for note in notes if note.startswith("fault: ")]
    assert faults == [f"fault: {one}" for one in ("lose servo=1", planned, "silence servo=1")]


def test_programs_of_the_page_run_against_the_servos_of_the_page(start: Start, tmp_path: Path) -> None:
    link = str(tmp_path / "robot")
    (words,) = re.findall(r"^    dxlrun sim (--servo XL430.+)$", page_text("simulation.md"), re.MULTILINE)
    (place,) = re.findall(r"--link (\S+)", words)
    words, *programs = (
        text.replace(place, link) for text in (words, *page_blocks("simulation.md", "python"))
    )
    sim = start(*words.split(), "--json")
    assert sim.result()["ports"] == {"main": link}
    path = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}

    def output_of(code: str) -> str | None:
        """Return what a program prints; None where it got no reply in time, on a busy machine."""
        ran = subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env=os.environ | path,
            check=False,
        )
        is_late = "(0, -3001, 0)" in ran.stdout or "timed out" in ran.stderr.lower()
        assert is_late or ran.returncode == 0, ran.stderr
        return None if is_late else ran.stdout

    said = [until(lambda code=code: output_of(code)) for code in programs]
    assert said[0] == "(1060, 0, 0)\n"
    assert len(json.loads(said[1])) == 3
    assert result_of(said[2]) == {"fault": "silence servo=2"}
    assert sim.stop()[0] == 0


def test_every_bus_is_simulated_and_has_a_link_that_follows_its_adapter(start: Start, tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text(TWO)
    sim = start("robot.yaml", "--link", "robot", "--json")
    printed = sim.result()
    ports = printed["ports"]
    assert ports == {name: str(tmp_path / f"robot.{name}") for name in ("left", "right")}
    assert {name: os.readlink(port) for name, port in ports.items()} == printed["devices"]
    assert hear(ports["left"], PING_1, 14)[:12] == PONG_1
    line = "unplug bus=left for=200ms"
    sim.type(line)
    for expected in ({"understood": line}, {"fault": line}, {"devices": {"left": ""}}):
        assert sim.result() == expected
    (back,) = sim.result()["devices"].values()
    assert back != printed["devices"]["left"]
    assert os.readlink(ports["left"]) == back
    assert hear(ports["left"], PING_1, 14)[:12] == PONG_1
    assert hear(ports["right"], OLD_PING, 6) == OLD_PONG
    assert sim.stop()[0] == 0
    assert not list(tmp_path.glob("robot.*t"))


def test_simulation_whose_process_dies_fails_with_a_sentence(start: Start) -> None:
    sim = start("--servo", "AX-12A:1", "--json", "--link", "robot")
    sim.line()
    os.kill(sim.child, signal.SIGKILL)
    code, _, err = sim.end()
    assert code == 1
    assert "simulation: the simulated bus exited unexpectedly" in err


def test_ledger_that_is_not_complete_fails_at_the_end(start: Start) -> None:
    sim = start("--servo", "AX-12A:1", "--json", "--ledger", "ledger.jsonl")
    port = sim.result()["ports"]["main"]
    resource.prlimit(sim.child, resource.RLIMIT_FSIZE, (100, 100))  # as a full disk; the sentence has room
    assert hear(port, OLD_PING, 6) == OLD_PONG
    code, _, err = sim.stop()
    assert code == 1
    assert err.startswith("simulation: the ledger is not complete: ")


def test_front_that_is_killed_leaves_no_link(start: Start, tmp_path: Path) -> None:
    sim = start("--servo", "AX-12A:1", "--json", "--link", "robot")
    sim.line()
    ended = os.pidfd_open(sim.child)
    sim.process.kill()
    assert select.select([ended], [], [], DEADLINE_S)[0]
    os.close(ended)
    assert not os.path.lexists(tmp_path / "robot")


def test_on_a_terminal_a_table_lives_and_letters_are_shown(tmp_path: Path) -> None:
    words = ("sim", "--servo", "XL430-W250:1-2")
    with Screen(tmp_path, *words, columns=120, TERM="xterm") as screen:
        screen.matches(r"2 +XL430-W250 +limp +\S+ +180\.0")
        mode = termios.tcgetattr(screen.terminal)
        mode[3] |= termios.ECHO  # as a shell may leave it after Ctrl-Z and fg
        termios.tcsetattr(screen.terminal, termios.TCSANOW, mode)
        screen.process.send_signal(signal.SIGCONT)
        while termios.tcgetattr(screen.terminal)[3] & termios.ECHO:
            screen.matches(rf"(?s).{{{len(plain(screen.shown))}}}.*asked")
        screen.types("overlaod\x7f\x7f\x7foad servo=2")
        screen.matches("fault> overload servo=2")
        screen.types("\n")
        screen.matches("\nfault: overload servo=2|\rfault: overload servo=2")
        screen.matches(r"2 +XL430-W250 .* 0x20")
        screen.types("\x03")  # Ctrl-C is a signal here as everywhere
        screen.matches("simulation: ended after")
        assert screen.ended() == 0
        assert termios.tcgetattr(screen.terminal)[3] & termios.ECHO  # as it was before
