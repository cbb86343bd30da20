"""Watch: mutual supervision of supervisor, guardian and loop: silence of a process, and the resulting duty.

Each of the three has a heartbeat in shared memory and watches the other two. The table of duties names, for
each set of silent processes, the one process that acts. Torque therefore goes off as long as one of the three
responds. Two processes that judge differently for a moment may both act; each action is safe to repeat.
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from enum import Enum, unique
from pathlib import Path

from dxlrun.channels.heartbeat import Heartbeat, Phase, Standstill
from dxlrun.process_table import PROC, UNKNOWN, read_stat

HALTED_NS = 250_000_000
"""Standstill after which /proc decides whether the process is stopped or dead. It is longer than two polls
of the supervisor, and longer than a profiler stops a process for a sample [i]. Including the shutdown of a
loop, torque is off within half a second."""
_PROC_INTERVAL_NS = 100_000_000
"""Shortest interval between two reads of a process' entry in /proc: the loop must not read files in each
cycle."""
GUARDIAN_TIMEOUT_NS = 5_000_000_000
"""Timeout of a guardian that the kernel reports neither stopped nor dead, and that may only wait for a
processor. The guardian checks the loop at least every 10 ms, and counts each of its own transactions."""
URGENT_TIMEOUT_NS = 100_000_000
"""Timeout of a guardian that must switch torque off, because the loop has exited or a cut was requested."""

SILENT_PERIODS = 5
"""Timeout of a running loop in periods."""
LEAST_TIMEOUT_NS = 80_000_000
"""Shortest timeout of a running loop. At high rates, a few periods are shorter than the worst wake-up of a
stock Linux (thesis: 17 ms), and shorter than the time for which a host of virtual machines takes a
processor away [i]. A robot that falls because of that was made safe for nothing."""
TORQUE_TIMEOUT_NS = 1_000_000_000
"""Timeout during start and shutdown with torque. Both beat while they wait for replies, which takes
milliseconds."""
SETUP_TIMEOUT_NS = 30_000_000_000
"""Timeout during set-up without torque: waiting for a machine that other programs keep busy does no harm."""
LOADING_TIMEOUT_NS = 60_000_000_000
"""Timeout of each plug-in's import and each on_configure: a neural network on a slow card takes 30 s [i]."""
ENDING_TIMEOUT_NS = 5_000_000_000
"""Timeout for exit handlers of plug-ins when the process of a finished loop exits."""


@unique
class WatchedProcess(Enum):
    """A watched process."""

    SUPERVISOR = "supervisor"
    GUARDIAN = "guardian"
    LOOP = "loop"


@unique
class Duty(Enum):
    """Action of a process when others are silent."""

    NONE = "nothing"
    STOP_LOOP = "ask the loop to stop; it ends as `on_exit` requires"
    KILL_LOOP = "kill the loop, and switch torque off in its place"
    KILL_GUARDIAN = "kill the guardian, so that Linux asks the loop to stop; it ends as `on_exit` requires"
    KILL_BOTH = "kill guardian and loop, and switch torque off in their place"
    END = "end the run as `on_exit` requires"


_DUTIES: Mapping[Set[WatchedProcess], tuple[WatchedProcess | None, Duty]] = {
    frozenset(): (None, Duty.NONE),
    frozenset({WatchedProcess.SUPERVISOR}): (WatchedProcess.GUARDIAN, Duty.STOP_LOOP),
    frozenset({WatchedProcess.GUARDIAN}): (WatchedProcess.SUPERVISOR, Duty.KILL_GUARDIAN),
    frozenset({WatchedProcess.LOOP}): (WatchedProcess.GUARDIAN, Duty.KILL_LOOP),
    frozenset({WatchedProcess.SUPERVISOR, WatchedProcess.GUARDIAN}): (WatchedProcess.LOOP, Duty.END),
    frozenset({WatchedProcess.SUPERVISOR, WatchedProcess.LOOP}): (WatchedProcess.GUARDIAN, Duty.KILL_LOOP),
    frozenset({WatchedProcess.GUARDIAN, WatchedProcess.LOOP}): (WatchedProcess.SUPERVISOR, Duty.KILL_BOTH),
}


def duty_of(watcher: WatchedProcess, silent: Set[WatchedProcess]) -> Duty:
    """Return the action of a process when these others are silent."""
    actor, duty = _DUTIES[frozenset(silent)]
    return duty if actor is watcher else Duty.NONE


class SignsOfLife:
    """Signs of life of a watched process: its heartbeat, and its state in the kernel.

    On a busy machine, a missing heartbeat alone proves little. A process that is stopped or dead will not
    respond, however long the wait; that evidence shortens the wait to `HALTED_NS`.
    """

    __slots__ = ("_folder", "_halted", "_look_ns", "_next_proc_ns", "_started", "_still", "still_ns")

    def __init__(self, pid: int, longest_look_ns: int, now_ns: int, proc: Path = PROC) -> None:
        """`longest_look_ns`: upper limit of the time that one check adds to a standstill.

        After a longer pause of the watcher, the watched process may not have run either.
        """
        self._folder = proc / str(pid)
        stat = read_stat(self._folder)
        # Without its start time, only the timeout decides, because another process may have the ID by now.
        self._started = stat.start_ticks if stat and stat.state != UNKNOWN else None
        self._halted = False
        self._look_ns = self._next_proc_ns = now_ns
        self._still = Standstill(longest_look_ns, now_ns)
        self.still_ns = 0
        """Standstill of the heartbeat."""

    def record_beat(self, beat: object, now_ns: int) -> int:
        """Record the heartbeat; return its standstill, ns."""
        self.still_ns = self._still.ns(beat, now_ns)
        self._look_ns = now_ns
        return self.still_ns

    def is_silent(self, timeout_ns: float) -> bool:
        """Return whether the process is silent: beyond its timeout, or stopped, or dead."""
        return self.still_ns > timeout_ns or self.is_halted()

    def is_halted(self) -> bool:
        """Return whether the process is stopped or dead; reads /proc only after HALTED_NS without a beat."""
        if self.still_ns <= HALTED_NS or self._started is None:
            self._halted = False
        elif self._look_ns >= self._next_proc_ns:
            self._next_proc_ns = self._look_ns + _PROC_INTERVAL_NS
            stat = read_stat(self._folder)
            self._halted = stat is None or stat.is_stopped or stat.has_ended(self._started)
        return self._halted


class LoopWatch:
    """The loop's watch over supervisor and guardian: heartbeats in memory, checked once per cycle.

    It asks the kernel only when neither has responded for `HALTED_NS`.
    """

    __slots__ = ("_guardian", "_heartbeat", "_supervisor")

    def __init__(
        self, heartbeat: Heartbeat, supervisor: int, guardian: int, period_ns: int, now_ns: int
    ) -> None:
        """`supervisor`, `guardian`: process IDs; `period_ns`: shortest interval of the checks."""
        self._heartbeat = heartbeat
        longest_ns = max(period_ns, URGENT_TIMEOUT_NS)
        self._supervisor = SignsOfLife(supervisor, longest_ns, now_ns)
        self._guardian = SignsOfLife(guardian, longest_ns, now_ns)

    def duty(self, now_ns: int) -> Duty:
        """Check both processes; return the loop's action."""
        guardian_ns = self._guardian.record_beat(self._heartbeat.looks, now_ns)
        supervisor_ns = self._supervisor.record_beat(self._heartbeat.supervisor_looks, now_ns)
        if min(guardian_ns, supervisor_ns) <= HALTED_NS:
            return Duty.NONE
        silent = frozenset(
            which
            for which, signs in (
                (WatchedProcess.GUARDIAN, self._guardian),
                (WatchedProcess.SUPERVISOR, self._supervisor),
            )
            if signs.is_silent(GUARDIAN_TIMEOUT_NS)
        )
        return duty_of(WatchedProcess.LOOP, silent)


def loop_timeout_ns(heartbeat: Heartbeat, period_ns: int) -> float:
    """Return the present timeout of the loop's heartbeat, ns; `period_ns`: default for its period."""
    phase = heartbeat.phase
    timeout_ns = standstill_timeout_ns(phase, heartbeat.cycle_ns or period_ns)
    if phase is Phase.RUNNING and not heartbeat.cycles:
        # Controllers are being activated; no goal has been commanded yet.
        return max(timeout_ns, TORQUE_TIMEOUT_NS)
    return timeout_ns


def standstill_timeout_ns(phase: Phase, period_ns: int) -> float:
    """Return the timeout of the loop's heartbeat in a phase, ns."""
    timeouts_ns = {
        Phase.LOADING: LOADING_TIMEOUT_NS,
        Phase.SETUP: SETUP_TIMEOUT_NS,
        Phase.RUNNING: max(SILENT_PERIODS * period_ns, LEAST_TIMEOUT_NS),
        Phase.DONE: ENDING_TIMEOUT_NS,
    }
    return timeouts_ns.get(phase, TORQUE_TIMEOUT_NS)
