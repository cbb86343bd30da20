"""`dxlrun` as a person starts it; two independent judges: the ledger's bytes, and what they did to torque."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import pytest

from dxlrun.channels.packets import PacketKind
from dxlrun.log.reader import Log, read_log
from dxlrun.simulation import LedgerEntry, read_ledger

DXLRUN = Path(sys.executable).with_name("dxlrun")
ROBOT = """\
name: pair
arguments:
  port: {default: sim, help: "serial port"}
  type: {default: joint_state_broadcaster, help: "type of the first controller"}
buses:
  main:
    port: "${port}"
    protocol: 1.0
    baud_rate: 1_000_000
    return_delay_time: 100 us
    adapter: {latency: 1 ms}
loop: {rate: 50, scheduler: {policy: round_robin, priority: 31}}
joints:
  pan: {bus: main, id: 3, model: AX-12A, reference: 150 deg, direction: 1}
  tilt: {bus: main, id: 7, model: AX-12A, reference: 150 deg, direction: -1}
controllers:
  states: {type: "${type}"}
  hold: {type: joint_group_position_controller, joints: [pan, tilt]}
"""
DEADLINE_S = 60.0
T = TypeVar("T")


def await_truth(look: Callable[[], T | None], what: str) -> T:
    """Return what `look` finds; fails when it finds nothing for a minute."""
    tick = threading.Event()
    give_up = time.monotonic() + DEADLINE_S
    while time.monotonic() < give_up:
        found = look()
        if found:
            return found
        tick.wait(0.02)
    raise AssertionError(f"waited {DEADLINE_S} s for {what}")


def packets_in(data: bytes) -> list[tuple[int, int, bytes]]:
    """Cut the host's bytes into (ID, instruction, parameters); the host must send nothing else."""
    found = []
    while data:
        assert data[:2] == b"\xff\xff", f"not a packet: {data[:16].hex()}"
        length = data[3]
        body, check = data[2 : 3 + length], data[3 + length]
        assert check == ~sum(body) & 0xFF
        found.append((data[2], data[4], data[5 : 3 + length]))
        data = data[4 + length :]
    return found


def torque_changes(ledger: tuple[LedgerEntry, ...], ids: tuple[int, ...]) -> Iterator[tuple[int, bool]]:
    """Follow what the bytes on the wire did to torque: address 24, and a goal position switches it on."""
    sent = b"".join(entry.data for entry in ledger if entry.direction == "in")
    for servo_id, instruction, parameters in packets_in(sent):
        writes: list[tuple[int, int, bytes]] = []
        if instruction == 0x03:
            targets = ids if servo_id == 0xFE else (servo_id,)
            writes = [(target, parameters[0], parameters[1:]) for target in targets]
        elif instruction == 0x83:
            size = parameters[1]
            rows = [parameters[at : at + size + 1] for at in range(2, len(parameters), size + 1)]
            writes = [(row[0], parameters[0], row[1:]) for row in rows]
        for target, address, data in writes:
            if address <= 24 < address + len(data):
                yield target, bool(data[24 - address])
            elif address <= 30 < address + len(data):
                yield target, True


@dataclass
class Running:
    """One `dxlrun` and what it leaves behind."""

    process: subprocess.Popen[str]
    directory: Path
    mark: str
    """In the environment of every process of this run, also of those whose parent is dead."""

    def processes(self) -> dict[str, int]:
        """Return the process IDs that live, by module; "dxlrun" is the terminal's."""
        found = {}
        for path in Path("/proc").glob("[0-9]*"):
            try:
                if self.mark.encode() not in (path / "environ").read_bytes():
                    continue
                command = (path / "cmdline").read_bytes().split(b"\0")
                state = (path / "stat").read_text().rsplit(")", 1)[1].split()[0]
            except OSError:
                continue
            if state not in "ZX" and command != [b""]:
                modules = [word.decode() for word in command if word.startswith(b"dxlrun.")]
                found[modules[0].removeprefix("dxlrun.") if modules else "dxlrun"] = int(path.name)
        return found

    def gone(self) -> bool:
        """Say whether no process of this run is left."""
        return not self.processes()

    def one(self, pattern: str) -> Path | None:
        """Return the file of the logs directory that matches, once there is one."""
        return next(iter((self.directory / "logs").glob(pattern)), None)

    def ledger(self) -> tuple[LedgerEntry, ...]:
        path = self.one("*.ledger.jsonl")
        return read_ledger(path) if path else ()

    def log(self) -> Log:
        path = self.one("*.mcap")
        assert path is not None
        return read_log(path)

    def wait_until_moving(self) -> None:
        """Wait until the loop has sent goals, and has gone on for a few cycles: goals that stay are rare."""

        def goals() -> bool:
            assert self.process.poll() is None, self.finish()
            sent = [entry.data[4:5] for entry in self.ledger() if entry.direction == "in"]
            return b"\x83" in sent and len(sent) - sent.index(b"\x83") >= 30

        await_truth(goals, "goals in the ledger")

    def child(self, module: str) -> int:
        """Return the process ID of one of dxlrun's own processes, once it is there."""
        return await_truth(lambda: self.processes().get(module.removeprefix("dxlrun.")), module)

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def finish(self) -> tuple[int, str, str]:
        """Return exit code, standard output, standard error."""
        out, err = self.process.communicate(timeout=DEADLINE_S + 30)
        return self.process.returncode, out, err


def _python_path() -> list[str]:
    return [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]


Start = Callable[..., Running]


@pytest.fixture
def start(tmp_path):
    """Start `dxlrun` on the robot `pair` (or another file) in a directory of its own."""
    (tmp_path / "pair.yaml").write_text(ROBOT)
    started: list[Running] = []

    def begin(
        *arguments, path=None, robot=None, closed=False, gateway=False, before=(), output=subprocess.PIPE
    ):
        paths = [str(path)] if path else []
        mark = f"DXLRUN_TEST={tmp_path}/{len(started)}"
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([*paths, *_python_path()])}
        environment |= dict([mark.split("=")])
        command = [*before, str(DXLRUN), str(robot or tmp_path / "pair.yaml"), *arguments]
        command += [] if gateway else ["--no-gateway"]
        close = f"exec >&- 2>&- <&-; exec {shlex.join(command)}"
        process = subprocess.Popen(
            ["/bin/sh", "-c", close] if closed else command,
            cwd=tmp_path,
            env=environment,
            text=True,
            stdout=output,
            stderr=output,
        )
        started.append(Running(process, tmp_path, mark))
        return started[-1]

    yield begin
    for running in started:
        if running.process.poll() is None:
            running.process.kill()
        running.process.communicate()
    for running in started:
        await_truth(running.gone, "the end of every process of the run")


@pytest.fixture
def all_limp():
    """Judge by the ledger alone that no servo of `pair` was left with torque."""

    def judge(running):
        state = {3: False, 7: False} | dict(torque_changes(running.ledger(), (3, 7)))
        return state == {3: False, 7: False}

    return judge


@pytest.fixture
def never_on_again():
    """Judge by the ledger alone that nothing switched torque on after anything had switched it off."""

    def judge(running):
        steps = [on for _, on in torque_changes(running.ledger(), (3, 7))]
        return not any(steps[steps.index(False) :]) if False in steps else not steps

    return judge


@pytest.fixture
def wire_and_log():
    """Return what the ledger has, and what the log has, each direction by itself."""

    def both(running):
        ledger, packets = running.ledger(), running.log().packets
        for direction, kinds in (
            ("in", {PacketKind.INSTRUCTION}),
            ("out", set(PacketKind) - {PacketKind.INSTRUCTION}),
        ):
            wire = b"".join(entry.data for entry in ledger if entry.direction == direction)
            ours = sorted((one for one in packets if one.kind in kinds), key=lambda one: one.first_ns)
            yield wire, b"".join(one.data for one in ours)

    return both


@pytest.fixture
def wire_equals_log(wire_and_log):
    """Compare the log with the ledger byte for byte."""

    def compare(running):
        for wire, ours in wire_and_log(running):
            assert ours == wire

    return compare


MOST_HELD = 64
"""Bytes of the longest exchange of `pair` with one servo."""


@pytest.fixture
def wire_equals_log_but_for_what_was_held(wire_and_log):
    """Compare the log with the ledger of a run whose loop was killed.

    A loop that is killed between the port and the memory that it shares takes one packet along, and no log
    can have it; everything before and after is there.
    """

    def compare(running):
        for wire, ours in wire_and_log(running):
            held = len(wire) - len(ours)
            assert 0 <= held <= MOST_HELD
            pairs = enumerate(zip(wire, ours, strict=False))
            same = next((index for index, (one, other) in pairs if one != other), len(ours))
            assert wire[same + held :] == ours[same:]

    return compare


@pytest.fixture
def wait_for():
    """Wait until something is true."""
    return await_truth
