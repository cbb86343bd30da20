"""Heartbeats: shared memory by which loop, guardian and supervisor see that the others respond.

`SimulationProgress` is the same for the process of simulated servos: how far it has served each line.

Each field has one writer: the supervisor for `supervisor_looks` and `steering`, the guardian for `looks`,
and the loop's process for the others. Each field is one aligned 64-bit store through a cast memoryview,
which 64-bit processors make whole. (`struct.pack_into` would not do: it clears its target first, and a
process killed in between would seem never to have begun.) A phase becomes visible behind what was shown
before it, and what makes the guardian's timeout shorter behind the beat before it: a guardian that saw it
without that beat would take what the loop did in the longer time for a standstill.
"""

from __future__ import annotations

from contextlib import suppress
from enum import IntEnum, unique
from pathlib import Path

from dxlrun.channels import shared_memory
from dxlrun.channels.shared_memory import load, store
from dxlrun.process_table import read_stat

_PHASE, _BEATS, _CYCLE, _SKIPPED, _LOOKS, _CYCLE_NS, _CALL, _SUPERVISOR_LOOKS, _STEERING = range(9)
_NAMES = 4096
_NAME_BYTES = 128
_MOST_NAMES = 64
_SIZE = _NAMES + _MOST_NAMES * _NAME_BYTES
_STEP_BITS = 8


@unique
class Phase(IntEnum):
    """How far the loop's process has come; the guardian's timeout depends on it."""

    LOADING = 0
    """No byte has been sent; plug-ins are imported and configured."""
    SETUP = 1
    """Servos are checked and set; no torque was switched on."""
    ENGAGING = 2
    """Torque is switched on."""
    RUNNING = 3
    STOPPING = 4
    DONE = 5
    """The loop itself has left the robot as by its policy: limp, as far as servos answered, or holding."""


@unique
class Steering(IntEnum):
    """Whether a run can be steered, as its supervisor knows it."""

    AWAITED = 0
    """The gateway was not started yet, or does not listen yet."""
    POSSIBLE = 1
    """The gateway listens."""
    IMPOSSIBLE = 2
    """The run has no gateway, or has lost it."""


@unique
class ControllerMethod(IntEnum):
    """What of a controller is called."""

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


def create() -> int:
    """Return the descriptor of a fresh page."""
    return shared_memory.create("heartbeat", _SIZE)


class Heartbeat:
    """The page, mapped; each process writes its own fields."""

    __slots__ = ("_beats", "_memory", "_words")

    def __init__(self, descriptor: int) -> None:
        self._memory = shared_memory.mapped(descriptor)
        self._words = self._memory.cast("Q")
        self._beats = 0

    def beat(self) -> None:
        """Show that the loop is alive; called once a cycle, and while replies are awaited."""
        self._beats += 1
        self._words[_BEATS] = self._beats

    def cycle(self, cycle: int, skipped: int) -> None:
        """Show how many cycles ran, and how many periods were skipped; the first one is a beat."""
        self._words[_SKIPPED] = skipped
        if cycle == 1:  # from here on the guardian waits for less
            self.beat()
            store(self._words, _CYCLE, cycle)
        else:
            self._words[_CYCLE] = cycle

    def may_take(self, cycle_ns: int) -> None:
        """Show how long a cycle may take from now on, ns: the period, or more while the loop is paused."""
        store(self._words, _CYCLE_NS, cycle_ns)

    def enter(self, phase: Phase) -> None:
        """Show that a phase begins."""
        store(self._words, _PHASE, phase)

    def name_controller(self, place: int, name: str) -> None:
        """Keep the name of the controller in this place; a very long one is cut."""
        data = name.encode()[:_NAME_BYTES].ljust(_NAME_BYTES, b"\0")
        self._memory[_NAMES + place * _NAME_BYTES :][:_NAME_BYTES] = data

    def call(self, place: int, step: int) -> None:
        """Show which controller is called, and what of it; a step of 0: none."""
        self._words[_CALL] = place << _STEP_BITS | step

    def look(self) -> None:
        """Show that the guardian watches; called by the guardian alone."""
        self._words[_LOOKS] += 1

    def supervisor_look(self) -> None:
        """Show that the supervisor watches; called by the supervisor alone."""
        self._words[_SUPERVISOR_LOOKS] += 1

    def set_steering(self, steering: Steering) -> None:
        """Publish whether the run can be steered; called by the supervisor alone."""
        self._words[_STEERING] = steering

    @property
    def steering(self) -> Steering:
        """Whether the run can be steered."""
        return Steering(self._words[_STEERING])

    @property
    def activity(self) -> str:
        """What of which controller was called and has not returned, as words; empty where there is none."""
        place, step = divmod(self._words[_CALL], 1 << _STEP_BITS)
        if not step:
            return ""
        name = bytes(self._memory[_NAMES + place * _NAME_BYTES :][:_NAME_BYTES]).rstrip(b"\0")
        return f"{ControllerMethod(step)} of controller {name.decode(errors='replace')}"

    @property
    def looks(self) -> int:
        """Number of times that the guardian has looked at the loop."""
        return self._words[_LOOKS]

    @property
    def supervisor_looks(self) -> int:
        """Number of times that the supervisor has looked at guardian and loop."""
        return self._words[_SUPERVISOR_LOOKS]

    @property
    def phase(self) -> Phase:
        """The phase that was entered last."""
        return Phase(load(self._words, _PHASE))

    @property
    def beats(self) -> int:
        """Number of beats."""
        return self._words[_BEATS]

    @property
    def cycles(self) -> int:
        """Number of cycles that ran."""
        return load(self._words, _CYCLE)

    @property
    def cycle_ns(self) -> int:
        """How long a cycle may take, ns; 0 before the loop has set it."""
        return load(self._words, _CYCLE_NS)

    @property
    def skipped(self) -> int:
        """Number of periods that were skipped."""
        return self._words[_SKIPPED]


_STALLS, _FIRST_STALL = 0, 1
_KEPT_STALLS = 16
_LINES = _FIRST_STALL + 2 * _KEPT_STALLS
_TAKEN, _SERVED, _GIVEN, _DUE = range(4)
_LINE_WORDS = 4


def create_progress(lines: int) -> int:
    """Return the descriptor of fresh memory for the progress of a simulation of so many lines."""
    return shared_memory.create("simulation", 8 * (_LINES + _LINE_WORDS * lines))


class SimulationProgress:
    """Time up to which the process of simulated servos has served its lines; it is the one writer.

    By this a reply that is late because that process had no core is distinguished from a servo that stays
    silent on purpose. All times are CLOCK_MONOTONIC, ns.
    """

    __slots__ = ("_words",)

    def __init__(self, descriptor: int) -> None:
        self._words = shared_memory.mapped(descriptor).cast("Q")

    def note_stall(self, begin_ns: int, end_ns: int) -> None:
        """Publish a time in which the process did not run although it had to."""
        count = self._words[_STALLS]
        place = _FIRST_STALL + 2 * (count % _KEPT_STALLS)
        self._words[place], self._words[place + 1] = begin_ns, end_ns
        store(self._words, _STALLS, count + 1)

    def stalled_ns(self, since_ns: int, until_ns: int) -> int:
        """Return for how long the process did not run between two times; of the last 16 stalls."""
        load(self._words, _STALLS)
        ends = self._words[_FIRST_STALL:_LINES]
        return sum(
            max(0, min(end_ns, until_ns) - max(begin_ns, since_ns))
            for begin_ns, end_ns in zip(ends[::2], ends[1::2], strict=True)
        )

    def line(self, index: int) -> LineProgress:
        """Return the progress on one line."""
        at = _LINES + index * _LINE_WORDS
        return LineProgress(self, self._words[at : at + _LINE_WORDS])


class LineProgress:
    """Progress of the simulation on one line."""

    __slots__ = ("_words", "process")

    def __init__(self, process: SimulationProgress, words: memoryview) -> None:
        self.process = process
        self._words = words

    # The simulation's side

    def serve(self, until_ns: int) -> None:
        """Publish that all bytes that reach the host before `until_ns` were handed over."""
        store(self._words, _SERVED, until_ns)

    def take(self, off_wire_ns: int) -> None:
        """Publish when the last byte is off the wire that was taken from the host, and executed."""
        store(self._words, _TAKEN, off_wire_ns)

    def give(self, due_ns: int, now_ns: int) -> None:
        """Publish when the newest bytes for the host were due, and that they are handed over now."""
        self._words[_DUE] = due_ns
        store(self._words, _GIVEN, now_ns)

    # The host's side

    @property
    def taken_ns(self) -> int:
        """When the last byte of the host is off the wire that the simulation has taken; to be read first."""
        return load(self._words, _TAKEN)

    @property
    def served_ns(self) -> int:
        """Time before which nothing is due to the host that it was not given."""
        return load(self._words, _SERVED)

    @property
    def given_ns(self) -> int:
        """When the newest bytes were handed over to the host; 0: none were."""
        return load(self._words, _GIVEN)

    @property
    def due_ns(self) -> int:
        """When these bytes were due."""
        return self._words[_DUE]


class Standstill:
    """How long something that should change has stood still, while the watcher itself was awake to see it.

    A machine that was suspended, a virtual machine that was paused, or a watcher that had to wait for a
    processor: the watched had no chance to move either, so one look counts for at most `longest_ns`.
    """

    __slots__ = ("_longest_ns", "_looked_ns", "_seen", "_still_ns")

    def __init__(self, longest_ns: int, now_ns: int) -> None:
        self._longest_ns = longest_ns
        self._looked_ns = now_ns
        self._still_ns = 0
        self._seen: object = None

    def ns(self, seen: object, now_ns: int) -> int:
        """Look: return for how long it has been what it is now, ns."""
        step = min(now_ns - self._looked_ns, self._longest_ns)
        self._looked_ns = now_ns
        self._still_ns = self._still_ns + step if seen == self._seen else 0
        self._seen = seen
        return self._still_ns


class ProcessorTime:
    """The processor time that a watched process got while it stood still, from /proc/PID.

    schedstat has it (kernel: Documentation/scheduler/sched-stats.rst), stat the state of its first thread
    (proc_pid_stat(5)). Both are read only while it stands still; a kernel without them gives no answer.
    """

    __slots__ = ("_begin_ns", "_folder")

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._begin_ns: int | None = None

    def look(self, still_ns: int) -> None:
        """Note the time it had when it began to stand still; `still_ns`: for how long it does."""
        if not still_ns:
            self._begin_ns = None
        elif self._begin_ns is None:
            self._begin_ns = self._total_ns()

    def starved_ns(self, still_ns: int) -> int | None:
        """Return what it got since it stands still, ns, if it could run and got less than half of the time.

        None where it waits for something else, used its processor, or nothing is known. To be asked before
        it is killed.
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
