"""`dxlrun` as a person starts it; two independent judges: the ledger's bytes, and what they did to torque."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.stories import plugin_folder
from tests.kit.wire import all_writes

from dxlrun.log.log_reader import Log, read_log
from dxlrun_controllers.group import JointGroupPositionController
from dxlsim.bus.ledger import LedgerEntry, read_ledger
from dxlwire.packets import PacketKind

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
PAIR: Any = SimpleNamespace(protocol=1.0, servos=[SimpleNamespace(servo_id=3), SimpleNamespace(servo_id=7)])
"""What the wire of `pair` is judged by."""


def torque_changes(ledger: tuple[LedgerEntry, ...]) -> Iterator[tuple[int, bool]]:
    """Follow what the bytes on the wire did to torque: address 24, and a goal position switches it on."""
    for _, servo_id, address, data in all_writes(ledger, PAIR):
        if address <= 24 < address + len(data):
            yield servo_id, bool(data[24 - address])
        elif address <= 30 < address + len(data):
            yield servo_id, True


@dataclass
class Running:
    """One `dxlrun` and what it leaves behind."""

    process: subprocess.Popen[str]
    directory: Path
    mark: str
    """In the environment of every process of this run, also of those whose parent is dead."""
    seen: Path
    """What the simulated buses saw."""

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
        return read_ledger(self.seen) if self.seen.exists() else ()

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

        until(goals, "goals in the ledger")

    def child(self, module: str) -> int:
        """Return the process ID of one of dxlrun's own processes, once it is there."""
        return until(lambda: self.processes().get(module.removeprefix("dxlrun.")), module)

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def finish(self) -> tuple[int, str, str]:
        """Return exit code, standard output, standard error."""
        out, err = self.process.communicate(timeout=DEADLINE_S)
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
        ledger = tmp_path / f"{len(started)}.ledger.jsonl"
        real = any(":=/" in str(argument) for argument in arguments)  # a port that another process serves
        if not real and not {"--virtual", "--ledger"} & {*arguments}:
            command += ["--ledger", str(ledger)]
        close = f"exec >&- 2>&- <&-; exec {shlex.join(command)}"
        process = subprocess.Popen(
            ["/bin/sh", "-c", close] if closed else command,
            cwd=tmp_path,
            env=environment,
            text=True,
            stdout=output,
            stderr=output,
        )
        started.append(Running(process, tmp_path, mark, ledger))
        return started[-1]

    yield begin
    for running in started:
        if running.process.poll() is None:
            running.process.kill()
        running.process.communicate()
    for running in started:
        until(running.gone, "the end of every process of the run")


PLUGIN = """\
import dxlrun, os, signal, sys, time
class Odd(dxlrun.Controller):
    @classmethod
    def interfaces(cls, parameters, joints):
        return dxlrun.Interfaces(joints=())
    def on_configure(self, context):
        {configure}
    def update(self, time_ns, period_ns):
        {update}
@dxlrun.hookimpl
def dxlrun_contract():
    return dxlrun.CONTRACT_VERSION
@dxlrun.hookimpl
def dxlrun_controllers():
    return {{'odd': Odd}}
"""


@pytest.fixture
def odd(start, tmp_path):
    """Start the robot with a controller of these two lines."""

    def begin(*arguments, configure="pass", update="pass"):
        (tmp_path / "plugins").mkdir()
        source = PLUGIN.format(configure=configure, update=update)
        path = plugin_folder(tmp_path / "plugins", "odd_controllers", source, "odd-controllers")
        return start("type:=odd", *arguments, path=path)

    return begin


@pytest.fixture
def acts(monkeypatch):
    """What group controllers of positions do in their updates, by name."""
    found = {}

    def update(controller, time_ns, period_ns):
        if act := found.get(controller.context.name):
            act(controller, time_ns)

    monkeypatch.setattr(JointGroupPositionController, "update", update)
    return found


@pytest.fixture
def all_limp():
    """Judge by the ledger alone that no servo of `pair` was left with torque."""

    def judge(running):
        state = {3: False, 7: False} | dict(torque_changes(running.ledger()))
        return state == {3: False, 7: False}

    return judge


@pytest.fixture
def never_on_again():
    """Judge by the ledger alone that nothing switched torque on after anything had switched it off."""

    def judge(running):
        steps = [on for _, on in torque_changes(running.ledger())]
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
    return until
