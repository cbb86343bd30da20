"""Mutual supervision of supervisor, guardian and loop: who watches whom, and what follows.

Guardian and loop watch both others, the supervisor too. Each has a heartbeat in shared memory. The table of
duties says for each set of silent processes which of the others acts, so that exactly one does: as long as
one of the three responds, torque goes off. It follows that two processes which judge differently for a
moment may both act; each act is safe to repeat.
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from enum import Enum, unique
from pathlib import Path

from dxlrun.channels.heartbeat import Heartbeat, Phase, Standstill
from dxlrun.process_table import PROC, UNKNOWN, read_stat

HALTED_NS = 250_000_000
"""Standstill after which /proc decides whether the process is stopped or dead: more than two polls of the
supervisor, and longer than a profiler holds a process for a sample [i]. With the shutdown of a loop, torque
is off within half a second."""
_PROC_INTERVAL_NS = 100_000_000
"""Least time between two readings of a process' entry in /proc: the loop may not read files in each cycle."""
GUARDIAN_TIMEOUT_NS = 5_000_000_000
"""The guardian looks at the loop at least every 10 ms, and counts each transaction of its own. One that the
kernel reports neither stopped nor dead has this long: it may only wait for a processor."""
URGENT_TIMEOUT_NS = 100_000_000
"""The same for a guardian that is to switch torque off: its loop has ended, or that was requested."""

SILENT_PERIODS = 5
"""A running loop whose counter stands still this long hangs."""
LEAST_TIMEOUT_NS = 80_000_000
"""At high rates a few periods are less than a stock Linux's worst wake-up (thesis: 17 ms), and than a host
of virtual machines takes a processor away [i]: a robot that falls for that was made safe for nothing."""
TORQUE_TIMEOUT_NS = 1_000_000_000
"""Start and shutdown beat while they await replies; each wait ends within milliseconds."""
SETUP_TIMEOUT_NS = 30_000_000_000
"""The same without torque: nothing is lost by waiting for a machine that other programs keep busy."""
LOADING_TIMEOUT_NS = 60_000_000_000
"""For each plug-in's import and each on_configure: a neural network on a slow card takes half of it [i]."""
ENDING_TIMEOUT_NS = 5_000_000_000
"""For what plug-ins left to be done when the process of a loop that is done ends."""


@unique
class Watched(Enum):
    """A process that others watch."""

    SUPERVISOR = "supervisor"
    GUARDIAN = "guardian"
    LOOP = "loop"


@unique
class Duty(Enum):
    """What a process does when others are silent."""

    NONE = "nothing"
    STOP_LOOP = "ask the loop to stop: it ends by on_exit"
    KILL_LOOP = "kill the loop, and switch torque off in its place"
    KILL_GUARDIAN = "kill the guardian: Linux then asks the loop to stop, which ends by on_exit"
    KILL_BOTH = "kill guardian and loop, and switch torque off in their place"
    END = "end the run by on_exit"


_DUTIES: Mapping[Set[Watched], tuple[Watched | None, Duty]] = {
    frozenset(): (None, Duty.NONE),
    frozenset({Watched.SUPERVISOR}): (Watched.GUARDIAN, Duty.STOP_LOOP),
    frozenset({Watched.GUARDIAN}): (Watched.SUPERVISOR, Duty.KILL_GUARDIAN),
    frozenset({Watched.LOOP}): (Watched.GUARDIAN, Duty.KILL_LOOP),
    frozenset({Watched.SUPERVISOR, Watched.GUARDIAN}): (Watched.LOOP, Duty.END),
    frozenset({Watched.SUPERVISOR, Watched.LOOP}): (Watched.GUARDIAN, Duty.KILL_LOOP),
    frozenset({Watched.GUARDIAN, Watched.LOOP}): (Watched.SUPERVISOR, Duty.KILL_BOTH),
}


def duty_of(watcher: Watched, silent: Set[Watched]) -> Duty:
    """Return what a process does when these others are silent."""
    actor, duty = _DUTIES[frozenset(silent)]
    return duty if actor is watcher else Duty.NONE


class SignsOfLife:
    """Judges whether a watched process responds: by its heartbeat, and by its state in the kernel.

    A heartbeat alone proves little on a busy machine. A process that is stopped or dead does not respond
    however long one waits: that is evidence, which shortens the wait to `HALTED_NS`.
    """

    __slots__ = ("_folder", "_halted", "_look_ns", "_next_proc_ns", "_started", "_still", "still_ns")

    def __init__(self, pid: int, longest_look_ns: int, now_ns: int, proc: Path = PROC) -> None:
        """`longest_look_ns`: a look counts for at most this; after a longer pause of the watcher the watched
        may not have run either."""
        self._folder = proc / str(pid)
        stat = read_stat(self._folder)
        # Without its time of start, only the timeout decides: another process may have the ID by now.
        self._started = stat.start_ticks if stat and stat.state != UNKNOWN else None
        self._halted = False
        self._look_ns = self._next_proc_ns = now_ns
        self._still = Standstill(longest_look_ns, now_ns)
        self.still_ns = 0
        """How long its heartbeat has stood still."""

    def look(self, beat: object, now_ns: int) -> int:
        """Note its heartbeat; return for how long that has stood still, ns."""
        self.still_ns = self._still.ns(beat, now_ns)
        self._look_ns = now_ns
        return self.still_ns

    def is_silent(self, timeout_ns: float) -> bool:
        """Return whether it does not respond: for longer than its timeout, or stopped or dead."""
        return self.still_ns > timeout_ns or self.is_halted()

    def is_halted(self) -> bool:
        """Return whether it is stopped or dead, and does not respond; reads /proc only where it does not."""
        if self.still_ns <= HALTED_NS or self._started is None:
            self._halted = False
        elif self._look_ns >= self._next_proc_ns:
            self._next_proc_ns = self._look_ns + _PROC_INTERVAL_NS
            stat = read_stat(self._folder)
            self._halted = stat is None or stat.is_stopped or stat.has_ended(self._started)
        return self._halted


class LoopWatch:
    """The loop's own watch over supervisor and guardian: heartbeats in memory, looked at once a cycle.

    The kernel is asked only when neither has responded for `HALTED_NS`.
    """

    __slots__ = ("_guardian", "_heartbeat", "_supervisor")

    def __init__(
        self, heartbeat: Heartbeat, supervisor: int, guardian: int, period_ns: int, now_ns: int
    ) -> None:
        """`supervisor`, `guardian`: process IDs; `period_ns`: of the looks, at the least."""
        self._heartbeat = heartbeat
        longest_ns = max(period_ns, URGENT_TIMEOUT_NS)
        self._supervisor = SignsOfLife(supervisor, longest_ns, now_ns)
        self._guardian = SignsOfLife(guardian, longest_ns, now_ns)

    def duty(self, now_ns: int) -> Duty:
        """Look at both; return what the loop has to do."""
        guardian_ns = self._guardian.look(self._heartbeat.looks, now_ns)
        supervisor_ns = self._supervisor.look(self._heartbeat.supervisor_looks, now_ns)
        if min(guardian_ns, supervisor_ns) <= HALTED_NS:
            return Duty.NONE
        silent = frozenset(
            which
            for which, signs in ((Watched.GUARDIAN, self._guardian), (Watched.SUPERVISOR, self._supervisor))
            if signs.is_silent(GUARDIAN_TIMEOUT_NS)
        )
        return duty_of(Watched.LOOP, silent)


def loop_timeout_ns(heartbeat: Heartbeat, period_ns: int) -> float:
    """Return how long the loop's heartbeat may stand still now, ns; `period_ns`: until the loop sets one."""
    phase = heartbeat.phase
    timeout_ns = standstill_timeout_ns(phase, heartbeat.cycle_ns or period_ns)
    if phase is Phase.RUNNING and not heartbeat.cycles:
        return max(timeout_ns, TORQUE_TIMEOUT_NS)  # controllers are activated; no goal was commanded yet
    return timeout_ns


def standstill_timeout_ns(phase: Phase, period_ns: int) -> float:
    """Return how long the loop's heartbeat may stand still in a phase, ns."""
    timeouts_ns = {
        Phase.LOADING: LOADING_TIMEOUT_NS,
        Phase.SETUP: SETUP_TIMEOUT_NS,
        Phase.RUNNING: max(SILENT_PERIODS * period_ns, LEAST_TIMEOUT_NS),
        Phase.DONE: ENDING_TIMEOUT_NS,
    }
    return timeouts_ns.get(phase, TORQUE_TIMEOUT_NS)
