"""Real runs: `dxlrun` as a person starts it, and two judges: the ledger's bytes, and what they did to torque.

The fixture `start` starts runs, and ends what a test leaves. `together` checks cases at the same time, where
they mostly wait.
"""

import itertools
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.packages import plugin_folder
from tests.kit.wire import all_writes

from dxlrun.channels.event_records import EventCode
from dxlrun.log.log_reader import Log, read_log
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
loop: {rate: 50, tolerated_skips: 100 %, scheduler: {policy: round_robin, priority: 31}}
joints:
  pan: {bus: main, id: 3, model: AX-12A, reference: 150 deg, direction: 1}
  tilt: {bus: main, id: 7, model: AX-12A, reference: 150 deg, direction: -1}
controllers:
  states: {type: "${type}"}
  hold: {type: joint_group_position_controller, joints: [pan, tilt]}
"""
PAIR: Any = SimpleNamespace(protocol=1.0, servos=[SimpleNamespace(servo_id=3), SimpleNamespace(servo_id=7)])
"""What the wire of `pair` is judged by."""
TORQUE_ENABLE, GOAL_POSITION = 24, 30
"""Addresses of an AX-12A; a goal position switches its torque on."""
SYNC_WRITE = b"\x83"
MOST_HELD = 64
"""Bytes of the longest exchange of `pair` with one servo."""
PLUGIN = """\
import ctypes, dxlrun, os, signal, sys, time
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


def torque_changes(ledger: Sequence[LedgerEntry]) -> Iterator[tuple[int, int, bool]]:
    """Follow what the bytes on the wire of `pair` did to torque: yield time, servo, and whether it is on."""
    for t_ns, servo, address, data in all_writes(ledger, PAIR):
        if address <= TORQUE_ENABLE < address + len(data):
            yield t_ns, servo, bool(data[TORQUE_ENABLE - address])
        elif address <= GOAL_POSITION < address + len(data):
            yield t_ns, servo, True


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
                if self.mark.encode() not in (path / "environ").read_bytes().split(b"\0"):
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
        """Return True where no process of this run is left."""
        return not self.processes()

    def child(self, module: str) -> int:
        """Return the process ID of one of dxlrun's own processes, once it is there."""
        return until(lambda: self.processes().get(module.removeprefix("dxlrun.")), module, check=self.lives)

    def lives(self) -> None:
        """Fail with the run's last words where it has ended."""
        assert self.process.poll() is None, self.finish()

    def wait_until_moving(self) -> None:
        """Wait until the loop has sent goals, and has gone on for a few cycles: goals that stay are rare."""

        def goals() -> bool:
            sent = [entry.data[4:5] for entry in self.ledger() if entry.direction == "in"]
            return SYNC_WRITE in sent and len(sent) - sent.index(SYNC_WRITE) >= 30

        until(goals, "goals in the ledger", check=self.lives, pause_s=0.05)

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def finish(self) -> tuple[int, str, str]:
        """Return exit code, standard output, standard error."""
        out, err = self.process.communicate(timeout=DEADLINE_S)
        return self.process.returncode, out, err

    def ledger(self) -> tuple[LedgerEntry, ...]:
        return read_ledger(self.seen) if self.seen.exists() else ()

    def sent(self) -> bytes:
        """Return by the ledger what the servos received."""
        return b"".join(entry.data for entry in self.ledger() if entry.direction == "in")

    def torque_changes(self) -> Iterator[tuple[int, bool]]:
        yield from ((servo, on) for _, servo, on in torque_changes(self.ledger()))

    def is_limp(self) -> bool:
        """Judge by the ledger alone that no servo of `pair` was left with torque."""
        return not any(dict(self.torque_changes()).values())

    def is_never_on_again(self) -> bool:
        """Judge by the ledger alone that nothing switched torque on after anything had switched it off."""
        steps = [on for _, on in self.torque_changes()]
        return not any(steps[steps.index(False) :]) if False in steps else not steps

    def last_sent_ns(self) -> int:
        """Return when the servos received something last."""
        return max(entry.t_ns for entry in self.ledger() if entry.direction == "in")

    def log_path(self) -> Path | None:
        """Return the log in the folder of logs, once there is one."""
        return next(iter((self.directory / "logs").glob("*.mcap")), None)

    def log(self) -> Log:
        path = self.log_path()
        assert path is not None
        return read_log(path)

    def guardians_word(self) -> str:
        """Return what the guardian reported to the log."""
        return " ".join(event.text for event in self.log().events if event.code == EventCode.GUARDIAN)

    def wire_and_log(self) -> Iterator[tuple[bytes, bytes]]:
        """Return what the ledger has, and what the log has, each direction by itself."""
        ledger, packets = self.ledger(), self.log().packets
        said = {PacketKind.INSTRUCTION}
        for direction, kinds in (("in", said), ("out", set(PacketKind) - said)):
            wire = b"".join(entry.data for entry in ledger if entry.direction == direction)
            ours = sorted((one for one in packets if one.kind in kinds), key=lambda one: one.first_ns)
            yield wire, b"".join(one.data for one in ours)

    def wire_is_logged(self, held: int = 0) -> bool:
        """Compare the log with the ledger byte for byte.

        `held`: bytes of one packet that a loop takes along that is killed between the port and the memory
        that it shares; no log can have it.
        """
        for wire, ours in self.wire_and_log():
            lost = len(wire) - len(ours)
            pairs = enumerate(zip(wire, ours, strict=False))
            same = next((index for index, (one, other) in pairs if one != other), len(ours))
            if not 0 <= lost <= held or wire[same + lost :] != ours[same:]:
                return False
        return True


Start = Callable[..., Running]


class LiveRuns:
    """Starts `dxlrun` on `pair` or another robot, each in a directory; a context manager, which ends them."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._started: list[Running] = []
        self._numbers = itertools.count()  # runs are started from several threads
        (directory / "pair.yaml").write_text(ROBOT)

    def start(
        self,
        *arguments: str,
        robot: Path | None = None,
        plugins: Path | None = None,
        directory: Path | None = None,
        gateway: bool = False,
        before: tuple[str, ...] = (),
        output: int = subprocess.PIPE,
    ) -> Running:
        """Start a run; `before`: the program and its words that become `dxlrun`."""
        directory, number = directory or self._directory, next(self._numbers)
        mark = f"{self._directory}/{number}"
        paths = [str(plugins)] if plugins else []
        paths += filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "DXLRUN_TEST": mark}
        command = [*before, str(DXLRUN), str(robot or self._directory / "pair.yaml"), *arguments]
        command += [] if gateway else ["--no-gateway"]
        ledger = directory / f"{number}.ledger.jsonl"
        real = any(":=/" in argument for argument in arguments)  # a port that another process serves
        if not real and "--virtual" not in arguments:
            command += ["--ledger", str(ledger)]
        process = subprocess.Popen(
            command, cwd=directory, env=environment, text=True, stdout=output, stderr=output
        )
        running = Running(process, directory, f"DXLRUN_TEST={mark}", ledger)
        self._started.append(running)
        return running

    def start_odd(
        self, *arguments: str, configure: str = "pass", update: str = "pass", **more: Any
    ) -> Running:
        """Start the robot with a controller of these two lines."""
        folder = self._directory / f"plugins{next(self._numbers)}"
        folder.mkdir()
        source = PLUGIN.format(configure=configure, update=update)
        plugin_folder(folder, "odd_controllers", source, "odd-controllers")
        return self.start("type:=odd", *arguments, plugins=folder, **more)

    def end(self) -> None:
        """Kill what is left of the runs."""
        for running in self._started:
            if running.process.poll() is None:
                running.process.kill()
            running.process.communicate()
        for running in self._started:
            until(running.gone, "the end of every process of the run")


@pytest.fixture
def live_runs(tmp_path: Path) -> Iterator[LiveRuns]:
    runs = LiveRuns(tmp_path)
    yield runs
    runs.end()


@pytest.fixture
def start(live_runs: LiveRuns) -> Start:
    """Start `dxlrun` on the robot `pair` (or another file) in a directory of its own."""
    return live_runs.start


def together(check: Callable[..., object], cases: Mapping[str, tuple[Any, ...]], most: int = 5) -> None:
    """Check all cases at the same time, at most so many, as they mostly wait; report all that failed."""
    with ThreadPoolExecutor(most) as pool:
        begun = {name: pool.submit(check, *case) for name, case in cases.items()}
    failed = []
    for name, one in begun.items():
        if (error := one.exception()) is not None:
            error.add_note(f"case: {name}")
            failed.append(error)
    if failed:
        raise BaseExceptionGroup(f"{len(failed)} of {len(cases)} cases failed", failed)
