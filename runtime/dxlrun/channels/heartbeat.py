"""Heartbeats: shared memory with which loop, guardian and supervisor check that the other two respond.

`SimulationProgress` has the same purpose for the process of simulated servos: its progress on each line.

Each field has one writer: the supervisor for `supervisor_looks` and `steering`, the guardian for `looks`, and
the loop's process for all others. A field is written with one aligned 64-bit store through a cast memoryview,
which 64-bit processors execute atomically. (`struct.pack_into` clears its target first, so a process that is
killed in between would leave 0.)

A phase becomes visible after all earlier writes. A value that shortens the guardian's timeout becomes visible
after the preceding beat. Otherwise the guardian would apply the shorter timeout to the time before the beat.
"""

from __future__ import annotations

import os
from contextlib import suppress
from enum import IntEnum, unique
from pathlib import Path

from dxlrun.channels import shared_memory
from dxlrun.channels.shared_memory import load, store
from dxlrun.process_table import SUPERVISOR, FoundRun, read_stat

_PHASE, _BEATS, _CYCLE, _SKIPPED, _LOOKS, _CYCLE_NS, _CALL, _SUPERVISOR_LOOKS, _STEERING = range(9)
_NAMES = 4096  # offset of the names of controllers, in bytes
_NAME_BYTES = 128
_MOST_NAMES = 64
_SIZE = _NAMES + _MOST_NAMES * _NAME_BYTES
_STEP_BITS = 8  # low bits of the word _CALL, which have the method; the others have the place


@unique
class Phase(IntEnum):
    """Phase of the loop's process, on which the guardian's timeout depends."""

    LOADING = 0
    """Plug-ins are imported and configured; nothing has been sent to servos."""
    SETUP = 1
    """Servos are checked and configured; torque is not enabled."""
    ENGAGING = 2
    """Torque is being enabled."""
    RUNNING = 3
    STOPPING = 4
    DONE = 5
    """The loop has left the robot according to its policy: limp, if servos replied, or holding."""


_ENDING = (Phase.STOPPING, Phase.DONE)


@unique
class GatewayAvailability(IntEnum):
    """Ability of clients to command the run through the gateway process."""

    AWAITED = 0
    """The gateway is starting and does not listen yet."""
    POSSIBLE = 1
    """The gateway listens: clients can send commands."""
    IMPOSSIBLE = 2
    """The run never had a gateway, or its gateway has exited."""


@unique
class ControllerMethod(IntEnum):
    """Number of a controller's method, for the page that shows which method is being called."""

    NONE = 0
    INIT = 1
    ON_CONFIGURE = 2
    ON_ACTIVATE = 3
    UPDATE = 4
    ON_COMMAND = 5
    ON_DEACTIVATE = 6
    ON_GOAL = 7
    ON_CANCEL = 8
    ON_PARAMETERS = 9
    ON_HOLD = 10
    ON_RESTART = 11

    def __str__(self) -> str:
        return "__init__" if self is ControllerMethod.INIT else self.name.lower()


def read_heartbeat(run: FoundRun) -> Heartbeat | None:
    """Map the heartbeat page of a run; return None if the run has none (yet, or any more)."""
    # The process may just have exited.
    with suppress(OSError, ValueError):
        if path := run.memory("heartbeat"):
            descriptor = os.open(path, os.O_RDWR)
            try:
                return Heartbeat(descriptor)
            finally:
                os.close(descriptor)
    return None


def is_ending(run: FoundRun) -> bool:
    """Return whether the loop is stopping the robot, has stopped it, or has died."""
    heartbeat = read_heartbeat(run)
    if heartbeat is None:
        return False
    phase = heartbeat.phase
    return phase in _ENDING or (phase is not Phase.LOADING and run.process("loop") is None)


def is_starting(run: FoundRun) -> bool:
    """Return whether a run will accept commands soon: its supervisor responds, its gateway will listen."""
    supervisor, gateway, heartbeat = run.process(SUPERVISOR), run.process("gateway"), read_heartbeat(run)
    if supervisor is None or supervisor.stat.is_stopped or is_ending(run):
        return False
    if gateway is not None and gateway.stat.is_stopped:
        return False
    return heartbeat is None or heartbeat.steering is GatewayAvailability.AWAITED


def create() -> int:
    """Return the descriptor of new shared memory for a heartbeat page."""
    return shared_memory.create("heartbeat", _SIZE)


class Heartbeat:
    """Heartbeat page in shared memory, mapped into this process. Each process writes its own fields."""

    __slots__ = ("_beats", "_memory", "_words")

    def __init__(self, descriptor: int) -> None:
        self._memory = shared_memory.mapped(descriptor)
        self._words = self._memory.cast("Q")
        self._beats = 0

    def beat(self) -> None:
        """Increment the loop's heartbeat. Called once a cycle, and during waits for replies."""
        self._beats += 1
        self._words[_BEATS] = self._beats

    def cycle(self, cycle: int, skipped: int) -> None:
        """Publish the numbers of executed cycles and skipped periods. The first cycle also sends a beat."""
        self._words[_SKIPPED] = skipped
        if cycle == 1:  # the guardian's timeout is shorter from now on
            self.beat()
            store(self._words, _CYCLE, cycle)
        else:
            self._words[_CYCLE] = cycle

    def may_take(self, cycle_ns: int) -> None:
        """Publish how long a cycle may take before the guardian intervenes, ns.

        That is the period, or more while the loop is paused.
        """
        store(self._words, _CYCLE_NS, cycle_ns)

    def enter_phase(self, phase: Phase) -> None:
        """Publish that the loop's process enters a phase."""
        store(self._words, _PHASE, phase)

    def name_controller(self, place: int, name: str) -> None:
        """Publish the name of the controller with this index, cut to 128 bytes."""
        data = name.encode()[:_NAME_BYTES].ljust(_NAME_BYTES, b"\0")
        self._memory[_NAMES + place * _NAME_BYTES :][:_NAME_BYTES] = data

    def call(self, place: int, step: int) -> None:
        """Publish index and method of the controller that is called from now on; step 0: no call."""
        self._words[_CALL] = place << _STEP_BITS | step

    def mark_guardian_alive(self) -> None:
        """Count a check by the guardian, to show that it is alive. Only the guardian calls it."""
        self._words[_LOOKS] += 1

    def supervisor_look(self) -> None:
        """Count a check by the supervisor, to show that it is alive. Only the supervisor calls it."""
        self._words[_SUPERVISOR_LOOKS] += 1

    def set_steering(self, steering: GatewayAvailability) -> None:
        """Publish whether clients can command the run. Only the supervisor calls it."""
        self._words[_STEERING] = steering

    @property
    def steering(self) -> GatewayAvailability:
        """Ability of clients to command the run, from the supervisor."""
        return GatewayAvailability(self._words[_STEERING])

    @property
    def activity(self) -> str:
        """Controller method that is running now, as text: `update of controller arm`; empty: none."""
        place, step = divmod(self._words[_CALL], 1 << _STEP_BITS)
        if not step:
            return ""
        name = bytes(self._memory[_NAMES + place * _NAME_BYTES :][:_NAME_BYTES]).rstrip(b"\0")
        return f"{ControllerMethod(step)} of controller {name.decode(errors='replace')}"

    @property
    def looks(self) -> int:
        """Number of checks by the guardian so far; it increases while the guardian is alive."""
        return self._words[_LOOKS]

    @property
    def supervisor_looks(self) -> int:
        """Number of checks by the supervisor so far; it increases while the supervisor is alive."""
        return self._words[_SUPERVISOR_LOOKS]

    @property
    def phase(self) -> Phase:
        """Phase in which the loop's process is now."""
        return Phase(load(self._words, _PHASE))

    @property
    def beats(self) -> int:
        """Number of heartbeats of the loop so far."""
        return self._words[_BEATS]

    @property
    def cycles(self) -> int:
        """Number of cycles that the loop has executed."""
        return load(self._words, _CYCLE)

    @property
    def cycle_ns(self) -> int:
        """Time that a cycle may take before the guardian intervenes, ns; 0: not set yet."""
        return load(self._words, _CYCLE_NS)

    @property
    def skipped(self) -> int:
        """Number of periods that the loop has skipped."""
        return self._words[_SKIPPED]


_STALLS, _FIRST_STALL = 0, 1
_KEPT_STALLS = 16
_LINES = _FIRST_STALL + 2 * _KEPT_STALLS
_TAKEN, _SERVED, _GIVEN, _DUE = range(4)
_LINE_WORDS = 4


def create_progress(lines: int) -> int:
    """Return the descriptor of new shared memory for the progress of simulated servos on `lines` buses."""
    return shared_memory.create("simulation", 8 * (_LINES + _LINE_WORDS * lines))


class SimulationProgress:
    """Progress of the process of simulated servos, which is the only writer.

    It distinguishes replies that are late because that process did not get a core from replies that are
    missing on purpose. All times are CLOCK_MONOTONIC, ns.
    """

    __slots__ = ("_words",)

    def __init__(self, descriptor: int) -> None:
        self._words = shared_memory.mapped(descriptor).cast("Q")

    def note_stall(self, begin_ns: int, end_ns: int) -> None:
        """Publish an interval, ns, in which the simulation should have run but got no core."""
        count = self._words[_STALLS]
        place = _FIRST_STALL + 2 * (count % _KEPT_STALLS)
        self._words[place], self._words[place + 1] = begin_ns, end_ns
        store(self._words, _STALLS, count + 1)

    def suspended_ns(self, since_ns: int, until_ns: int) -> int:
        """Return how long the simulation stalled between two times, ns. Only the last 16 stalls are known."""
        load(self._words, _STALLS)
        ends = self._words[_FIRST_STALL:_LINES]
        return sum(
            max(0, min(end_ns, until_ns) - max(begin_ns, since_ns))
            for begin_ns, end_ns in zip(ends[::2], ends[1::2], strict=True)
        )

    def line(self, index: int) -> LineProgress:
        """Return the simulation's progress on the bus line with this index."""
        at = _LINES + index * _LINE_WORDS
        return LineProgress(self, self._words[at : at + _LINE_WORDS])


class LineProgress:
    """Progress of the process of simulated servos on one bus line, in shared memory."""

    __slots__ = ("process", "words")

    def __init__(self, process: SimulationProgress, words: memoryview) -> None:
        self.process = process
        self.words = words
        """The numbers of the properties, which the compiled simulation publishes."""

    @property
    def taken_ns(self) -> int:
        """Time at which the last byte that the simulation executed left the wire, ns. Must be read first."""
        return load(self.words, _TAKEN)

    @property
    def served_ns(self) -> int:
        """Time before which all simulated bytes that are due were delivered to the loop, ns."""
        return load(self.words, _SERVED)

    @property
    def given_ns(self) -> int:
        """Time of the newest delivery of simulated bytes to the loop, ns; 0: none."""
        return load(self.words, _GIVEN)

    @property
    def due_ns(self) -> int:
        """Time at which the newest delivered bytes were due, ns."""
        return self.words[_DUE]


class Standstill:
    """Duration for which a watched value has not changed while the watcher itself was running.

    If the machine was suspended, or the watcher waited for a processor, the watched process could not run
    either. So the time between two checks counts as at most `longest_ns`.
    """

    __slots__ = ("_longest_ns", "_looked_ns", "_seen", "_still_ns")

    def __init__(self, longest_ns: int, now_ns: int) -> None:
        self._longest_ns = longest_ns
        self._looked_ns = now_ns
        self._still_ns = 0
        self._seen: object = None

    def ns(self, seen: object, now_ns: int) -> int:
        """Compare the watched value with the last one, and return how long it has not changed, ns.

        Args:
            seen: Current value.
            now_ns: Current time.
        """
        step = min(now_ns - self._looked_ns, self._longest_ns)
        self._looked_ns = now_ns
        self._still_ns = self._still_ns + step if seen == self._seen else 0
        self._seen = seen
        return self._still_ns


class ProcessorTime:
    """Processor time that a watched process used during a standstill, from /proc/PID.

    The time is in schedstat (kernel: Documentation/scheduler/sched-stats.rst), the state of the first thread
    in stat (proc_pid_stat(5)). Both are read only during a standstill. They may be missing in a kernel.
    """

    __slots__ = ("_begin_ns", "_folder")

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._begin_ns: int | None = None

    def note_standstill(self, still_ns: int) -> None:
        """Store the processor time when a standstill begins, and forget it when the standstill ends.

        Args:
            still_ns: Duration of the standstill so far; 0: none.
        """
        if not still_ns:
            self._begin_ns = None
        elif self._begin_ns is None:
            self._begin_ns = self._total_ns()

    def starved_ns(self, still_ns: int) -> int | None:
        """Return the process's processor time since the begin of the standstill if it was starved of cores.

        It must be called before the process is killed.

        Args:
            still_ns: Duration of the standstill.

        Returns:
            Processor time, ns, if the process was ready to run and got less than half of the duration; else
            None.
        """
        total_ns = self._total_ns()
        if self._begin_ns is None or total_ns is None or not self._may_run():
            return None
        got_ns = total_ns - self._begin_ns
        return got_ns if 2 * got_ns < still_ns else None

    def _total_ns(self) -> int | None:
        with suppress(OSError, ValueError, IndexError):
            return int((self._folder / "schedstat").read_text().split()[0])
        return None

    def _may_run(self) -> bool:
        stat = read_stat(self._folder)
        return stat is not None and stat.state == "R"
