"""Campaign: two hits, KILL or STOP, on two processes of a run; its servos are simulated by another process.

One survivor of main process, guardian and loop takes torque off. Recorder and gateway do not end control.
Afterwards nothing of the run is left but processes that are stopped, or that wait for one that is, and
`dxlrun stop` ends these. Torque must be off in time after the last hit on these three, not counting the time
for which the kernel let servos, survivors or this process wait for a processor. Each pair prints both.
"""

import math
import os
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import pytest
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.bus_process import BusProcess
from tests.kit.campaigns import campaign
from tests.kit.live_run import DXLRUN, ROBOT, Running, Start, together, torque_changes

from dxlrun.remote.sockets import sockets
from dxlsim.bus.ledger import read_ledger
from dxlsim.simulation_plan import BusConfig, ServoConfig

IDS = (3, 7)
MODULES = {
    "main": "dxlrun",
    "guardian": "run.guardian",
    "loop": "run.loop_process",
    "recorder": "log.recorder",
    "gateway": "remote",
}
IN_CONTROL = ("main", "guardian", "loop")
SETTLED_S = 1.5
"""After it `dxlrun stop` is to end what is left, whether it would have ended by itself or not."""
LONGEST_MS = {"ci": 2500, "release": 1000}
"""From the last hit to torque off, where other tests run too, and on a quiet machine.

A survivor that waits for its timeout of 5 s is too late.
"""
PAUSES_S = (0.0, 0.02, 0.1, 0.3)
"""Between the hits, in turn: before, while and after the first one is noticed."""


class Hit(NamedTuple):
    """A signal to one of the processes."""

    process: str
    signal: str

    def __str__(self) -> str:
        return f"{self.process}_{self.signal}"


HITS = tuple(Hit(process, number) for process in MODULES for number in ("KILL", "STOP"))
TELLING = (
    (Hit("guardian", "STOP"), Hit("main", "KILL")),
    (Hit("main", "STOP"), Hit("guardian", "STOP")),
    (Hit("main", "STOP"), Hit("gateway", "STOP")),
    (Hit("main", "KILL"), Hit("loop", "STOP")),
    (Hit("guardian", "STOP"), Hit("loop", "STOP")),
    (Hit("guardian", "KILL"), Hit("loop", "STOP")),
    (Hit("guardian", "STOP"), Hit("recorder", "KILL")),
    (Hit("gateway", "STOP"), Hit("recorder", "KILL")),
)


PAIRS = tuple(
    dict.fromkeys((*TELLING, *((first, second) for first in HITS for second in HITS if first != second)))
)
"""All 90 pairs, the telling ones first."""


class Servos(BusProcess):
    """The simulated servos, whose ledger is the judge."""

    def __init__(self, folder: Path) -> None:
        servos = tuple(ServoConfig(each, "AX-12A", math.radians(150)) for each in IDS)
        self.seen = folder / "servos.jsonl"
        super().__init__((BusConfig("main", 1_000_000, servos),), self.seen)

    def instructions(self) -> int:
        """Return the number of instructions that the servos received."""
        return sum(entry.direction == "in" for entry in read_ledger(self.seen))

    def torque(self) -> dict[int, tuple[bool, int]]:
        """Return by servo ID whether torque is on, and since when (ns); only where it was written."""
        found: dict[int, tuple[bool, int]] = {}
        for t_ns, servo, on in torque_changes(read_ledger(self.seen)):
            if found.get(servo, (False, 0))[0] != on:
                found[servo] = on, t_ns
        return found

    def are_limp(self) -> bool:
        return not any(on for on, _ in self.torque().values())


class Starvation:
    """Time for which processes were ready to run and had no processor (kernel: sched-stats.rst)."""

    def __init__(self, *pids: int) -> None:
        self._first = {pid: waited_ns(pid) for pid in pids}
        self._last = dict(self._first)

    def look(self) -> None:
        """Note the times; those of a process that has ended remain."""
        for pid, before_ns in self._last.items():
            self._last[pid] = max(before_ns, waited_ns(pid))

    @property
    def total_ms(self) -> float:
        """Their sum since the beginning: the processes wait for each other."""
        return (sum(self._last.values()) - sum(self._first.values())) / 1e6


def waited_ns(pid: int) -> int:
    """Return for how long a process has waited for a processor; 0 when it has ended."""
    with suppress(OSError, IndexError):
        return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1])
    return 0


def controlled(start: Start, folder: Path, servos: Servos, *, gateway: bool) -> Running:
    """Return a run of `pair` under its own name that controls the servos; a gateway only to be hit."""
    name = f"pair_{os.getpid()}_{folder.name}"
    robot = folder / "pairs.yaml"
    robot.write_text(
        ROBOT.replace("latency: 1 ms", "latency: 4 ms").replace("name: pair", f"name: {name}", 1)
    )
    run = start(f"port:={servos.ports['main']}", robot=robot, gateway=gateway, directory=folder)
    wanted = {module for name, module in MODULES.items() if gateway or name != "gateway"}
    until(lambda: wanted <= set(run.processes()), "all processes", check=run.lives)
    if gateway:  # before it listens, its end ends a run on a real port: the robot was held for it
        until(lambda: name in sockets(), "the socket", check=run.lives)
    until(lambda: sum(on for on, _ in servos.torque().values()) == len(IDS), "torque", check=run.lives)
    in_control(servos)
    return run


def in_control(servos: Servos) -> None:
    """Wait for twenty more exchanges, torque on."""
    before = servos.instructions()
    until(lambda: servos.instructions() > before + 20, "more exchanges")
    assert [on for on, _ in servos.torque().values()] == [True] * len(IDS)


def end_what_is_left(run: Running) -> str:
    """Wait until the processes are gone, or end them by `dxlrun stop`, which must find them.

    Return what the run wrote to standard error.
    """
    with suppress(subprocess.TimeoutExpired):
        run.process.wait(SETTLED_S)  # reaped: a dead child of this process is none that is left
    end = time.monotonic() + SETTLED_S
    while not run.gone() and time.monotonic() < end:
        time.sleep(0.05)
    if left := run.processes():
        name = f"pair_{os.getpid()}_{run.directory.name}"
        done = subprocess.run(
            [DXLRUN, "stop", "--robot", name], capture_output=True, text=True, timeout=DEADLINE_S, check=False
        )
        print(f"left: {', '.join(sorted(left))}; dxlrun stop: {done.stdout.strip()} {done.stderr.strip()}")
        assert done.returncode == 0, done.stderr
        assert name in done.stdout
    _, _, err = run.finish()
    until(run.gone, "the end of every process")
    assert "Traceback" not in err
    return err


def check_pair(start: Start, folder: Path, pair: tuple[Hit, Hit], pause_s: float, longest_ms: float) -> None:
    """Let two hits happen to a run, and judge when torque was off."""
    folder.mkdir()
    with Servos(folder) as servos:
        run = controlled(start, folder, servos, gateway="gateway" in {hit.process for hit in pair})
        pids = run.processes()
        starvation = Starvation(os.getpid(), servos.child.pid, *(pids[MODULES[one]] for one in IN_CONTROL))
        hit_ns = 0
        for hit in pair:
            if hit.process in IN_CONTROL:
                hit_ns = time.monotonic_ns()
            with suppress(ProcessLookupError):  # it ended because of the first
                os.kill(pids[MODULES[hit.process]], signal.Signals[f"SIG{hit.signal}"])
            time.sleep(pause_s)
        if not hit_ns:
            in_control(servos)
            run.signal(signal.SIGINT)

        def limp() -> bool:
            starvation.look()
            return servos.are_limp()

        until(limp, "torque off")
        if hit_ns:
            after_ms = (max(since_ns for _, since_ns in servos.torque().values()) - hit_ns) / 1e6
            starved_ms = starvation.total_ms
            print(
                f"TORQUE OFF after {after_ms:.0f} ms, {starved_ms:.0f} ms without a processor: "
                f"{pair[0]}, {pair[1]} {pause_s * 1e3:.0f} ms later"
            )
            assert after_ms - starved_ms < longest_ms
        err = end_what_is_left(run)
        assert servos.are_limp()
    if pair == (Hit("main", "STOP"), Hit("gateway", "STOP")):  # as `fg` shows it
        assert "was suspended (such as by Ctrl-Z)" in " ".join(err.split())


@pytest.mark.timeout(300)  # several runs
@campaign(ci=4, night=20, release=len(PAIRS))
def test_one_survivor_takes_torque_off(start: Start, tmp_path: Path, amount: float) -> None:
    full = amount == len(PAIRS)
    longest_ms = LONGEST_MS["release" if full else "ci"]
    cases = {
        f"{first}, {second}": (
            start,
            tmp_path / str(number),
            (first, second),
            PAUSES_S[number % len(PAUSES_S)],
            longest_ms,
        )
        for number, (first, second) in enumerate(PAIRS[: int(amount)])
    }
    assert cases
    together(check_pair, cases, most=1 if full else 4)
