"""Processes of a run: how one starts another, the memory they share, and the typed messages between them."""

from __future__ import annotations

import ctypes
import io
import os
import select
import signal
import socket
import subprocess
import sys
from collections import deque
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain
from typing import Generic, TypeVar

import msgspec

from dxlrun.errors import PortError, ProcessFault

START_TIMEOUT_S = 20.0
"""For a child's first message; a cold import of numpy takes a second."""
END_TIMEOUT_S = 10.0
"""Also for a recorder on a slow disk, which reports after each step that it is at work."""

_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Importing numpy alone starts a thread for each core otherwise."""
_LINE_LIMIT = 1 << 20
_MOST_DESCRIPTORS = 64


def spare_core(taken: Collection[int]) -> int:
    """Return the last core that this process may use and that is not taken; the last one if all are."""
    allowed = os.sched_getaffinity(0)
    return max(allowed.difference(taken) or allowed)


def start_module(
    module: str, arguments: Sequence[str], descriptors: Iterable[int], errors: int
) -> subprocess.Popen[bytes]:
    """Execute `python -m module` in a session of its own, so that a terminal's Ctrl-C does not reach it.

    `descriptors` are inherited; `errors` takes what it prints, which only --debug shows. `-P` keeps the
    working directory out of the import path: a student's `numpy.py` beside the robot file must not be
    imported.
    """
    return subprocess.Popen(
        [sys.executable, "-P", "-m", module, *arguments],
        pass_fds=tuple(descriptors),
        stdin=subprocess.DEVNULL,
        stdout=errors,
        stderr=errors,
        start_new_session=True,
        env=os.environ | _ONE_THREAD,
    )


def memory_file(name: str, content: bytes = b"") -> int:
    """Return the descriptor of a nameless file (memfd) with `content`."""
    descriptor = os.memfd_create(name)
    os.pwrite(descriptor, content, 0)
    return descriptor


def whole(descriptor: int) -> bytes:
    """Return everything in a nameless file, wherever its offset is."""
    return os.pread(descriptor, os.fstat(descriptor).st_size, 0)


class Printed(io.TextIOBase):
    """Takes what plug-ins print, unbuffered and bounded: a controller that prints each cycle fills no memory.

    `descriptor` is the nameless file that `start_module` made the process' output; --debug shows it.
    """

    def __init__(self, descriptor: int, most: int = 1 << 20) -> None:
        super().__init__()
        self._descriptor = descriptor
        self._room = most

    def writable(self) -> bool:
        """Return True."""
        return True

    def fileno(self) -> int:
        """Return the descriptor behind it."""
        return self._descriptor

    def write(self, text: str, /) -> int:
        """Keep the text, as long as there is room; never raises."""
        data = text.encode(errors="replace")[: self._room]
        self._room -= len(data)
        with suppress(OSError):
            os.write(self._descriptor, data)
            if data and not self._room:
                os.write(self._descriptor, b"\n(what was printed after this is left out)\n")
        return len(text)


@dataclass(frozen=True, slots=True)
class RunMemory:
    """Descriptors of everything that the processes of a run share; nameless, gone with the last of them."""

    plan: int
    heartbeat: int
    cycles: int
    packets: int
    desk: int
    """The packets of the unfinished cycle."""
    events: int
    """Of the loop, and the commands that its cycles took."""
    messages: int
    """Topics of the loop."""
    guardian: int
    """Packets and events of the guardian."""
    result: int
    """How the loop ended."""
    mailbox: int
    answers: int
    grants: int
    """What the operating system granted to the loop."""
    stderr: int
    kept: int
    """What controllers kept in earlier runs."""
    span: int
    """Which cycles the log has on the disk, written by the recorder at each flush."""
    slots: dict[str, tuple[int, ...]] = field(default_factory=dict)
    """Slots of the processes of each feature, by its name."""
    shafts: int = -1
    """Slot of the shafts of simulated servos, for processes that sense the simulated body; -1: none does."""
    simulation: int = -1
    """Progress of the simulation; -1: no bus is simulated."""

    @property
    def of_loop(self) -> tuple[int, ...]:
        """Those that the loop's process inherits."""
        rings = (self.cycles, self.packets, self.desk, self.events, self.messages, self.mailbox, self.answers)
        simulated = (self.simulation,) if self.simulation >= 0 else ()
        own = (self.result, self.grants, self.kept, *chain(*self.slots.values()), *simulated)
        return (self.plan, self.heartbeat, *rings, *own)

    @property
    def recorded(self) -> dict[str, int]:
        """The rings that the recorder reads, by the name under which it reports missing records."""
        return {
            "loop/cycles": self.cycles,
            "loop/packets": self.packets,
            "loop/events": self.events,
            "loop/messages": self.messages,
            "guardian": self.guardian,
        }


class Failed(msgspec.Struct, frozen=True, tag=True):
    """A process does not start, or cannot do its work any more."""

    sentence: str


class Stop(msgspec.Struct, frozen=True, tag=True):
    """Terminal to guardian: stop the robot in order."""


class Cut(msgspec.Struct, frozen=True, tag=True):
    """Terminal to guardian: kill the loop and cut torque."""


class LineLost(msgspec.Struct, frozen=True, tag=True):
    """Loop to guardian, and on to the terminal: the port of a bus is gone; let go of it."""

    bus: int
    """Index in the plan's buses."""


class LineReturned(msgspec.Struct, frozen=True, tag=True):
    """Guardian to loop and terminal: the port of a bus is open again; its descriptor is sent with it."""

    bus: int


class Finish(msgspec.Struct, frozen=True, tag=True):
    """Supervisor to recorder: drain the rings and close the log."""


class LateMetadata(msgspec.Struct, frozen=True, tag=True):
    """Supervisor to recorder: what became known in the run, for the end of the log."""

    records: dict[str, dict[str, str]]


class LoopRuns(msgspec.Struct, frozen=True, tag=True):
    """Supervisor to recorder: the loop has a process; what it gets of the machine belongs into the log."""

    pid: int


class Ready(msgspec.Struct, frozen=True, tag=True):
    """Recorder to supervisor: the log is open."""


class Draining(msgspec.Struct, frozen=True, tag=True):
    """Recorder to supervisor: still at work on what the rings hold."""


class Listening(msgspec.Struct, frozen=True, tag=True):
    """Gateway to supervisor: clients can connect."""

    socket: str
    """Path."""


Received = TypeVar("Received")


class MessageChannel(Generic[Received]):
    """One end of a conversation between two processes: JSON, one message a line."""

    def __init__(self, end: socket.socket, received: msgspec.json.Decoder[Received]) -> None:
        self._socket = end
        self._decoder = received
        self._pending = b""
        self.closed = False
        """True after the end of what the other end sent was read."""
        self.descriptors: list[int] = []
        """What the other end handed over."""

    def fileno(self) -> int:
        """Return the descriptor, for select."""
        return self._socket.fileno()

    def send(self, message: object, descriptors: Sequence[int] = ()) -> None:
        """Send one message, and open descriptors with it; never raises.

        An end that is gone is noticed by the next receive, not here: its last messages are still to be read.
        """
        data = msgspec.json.encode(message) + b"\n"
        with suppress(OSError):
            if descriptors:
                socket.send_fds(self._socket, [data], descriptors)
            else:
                self._socket.sendall(data)

    def receive(self) -> list[Received]:
        """Return the messages that arrive in one read; waits for one read, sets `closed` at its end."""
        try:
            chunk, descriptors, _, _ = socket.recv_fds(self._socket, 65536, _MOST_DESCRIPTORS)
            self.descriptors += descriptors
        except OSError:
            chunk = b""
        if not chunk or len(self._pending) > _LINE_LIMIT:
            self.closed = True
        *lines, self._pending = (self._pending + chunk).split(b"\n")
        return [self._decoder.decode(line) for line in lines]

    def close(self) -> None:
        """Close this end."""
        self._socket.close()


def message_channel(
    received: msgspec.json.Decoder[Received],
) -> tuple[MessageChannel[Received], socket.socket]:
    """Return our end, and the other one to be inherited by a child (close it here after the start)."""
    ours, theirs = socket.socketpair()
    return MessageChannel(ours, received), theirs


Job = TypeVar("Job")
_PR_SET_PDEATHSIG = 1


def begun(job: type[Job], received: msgspec.json.Decoder[Received]) -> tuple[Job, MessageChannel[Received]]:
    """Begin a process that is a `Child`, executed with `--job-fd N --control-fd M`: only the supervisor takes
    Ctrl-C. Return what it is to do, and its end of the channel."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    found = msgspec.json.decode(whole(int(sys.argv[2])), type=job)
    return found, MessageChannel(socket.socket(fileno=int(sys.argv[4])), received)


def hold_foreign_code(number: signal.Signals) -> None:
    """Bound what plug-ins print, and have Linux send this signal when the parent dies (prctl(2))."""
    sys.stdout = sys.stderr = Printed(sys.stderr.fileno())
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)


class Child(Generic[Received]):
    """One process that this one started, and the channel to it."""

    def __init__(  # noqa: PLR0917  how it is called, what is executed, and what it inherits
        self,
        name: str,
        module: str,
        arguments: list[str],
        descriptors: list[int],
        stderr: int,
        received: msgspec.json.Decoder[Received],
    ) -> None:
        self.name = name
        self.channel, theirs = message_channel(received)
        control = ["--control-fd", str(theirs.fileno())]
        self.process: subprocess.Popen[bytes] = start_module(
            module, [*arguments, *control], [*descriptors, theirs.fileno()], stderr
        )
        theirs.close()
        self._messages: deque[Received] = deque()

    def message(self, timeout_s: float) -> Received | None:
        """Return its next message; None when its end of the channel is closed.

        Raises ProcessFault when none comes in time.
        """
        while not self._messages and not self.channel.closed:
            ready, _, _ = select.select([self.channel], [], [], timeout_s)
            if not ready:
                raise ProcessFault(f"the {self.name} did not answer for {timeout_s:.0f} s")
            self._messages.extend(self.channel.receive())
        return self._messages.popleft() if self._messages else None

    def poll(self, timeout_s: float, *others: int) -> Received | None:
        """Return the message that comes within `timeout_s`; None when none does, or one of `others` is ready.

        `others`: descriptors.
        """
        if not self._messages:
            ready, _, _ = select.select([self.channel.fileno(), *others], [], [], timeout_s)
            if self.channel.fileno() in ready:
                self._messages.extend(self.channel.receive())
        return self._messages.popleft() if self._messages else None

    def ready(self) -> Received:
        """Return its first message. Raises ProcessFault when it ends before it, PortError for Failed."""
        message = self.message(START_TIMEOUT_S)
        if message is None:
            code = self.process.wait(END_TIMEOUT_S)
            raise ProcessFault(f"the {self.name} ended while it started (exit code {code}); try --debug")
        if isinstance(message, Failed):
            raise PortError(message.sentence)
        return message

    def exited(self, timeout_s: float = 0.0) -> bool:
        """Return whether it ends within a time; it is not reaped, so that its number stays its own."""
        if self.process.returncode is not None:
            return True
        descriptor = os.pidfd_open(self.process.pid)
        try:
            return bool(select.select([descriptor], [], [], timeout_s)[0])
        finally:
            os.close(descriptor)

    def kill(self) -> None:
        """End it at once, whatever it does, and what it has started and left in its session's group."""
        if self.process.returncode is None:
            with suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
        self.channel.close()

    def end(self) -> None:
        """Close the channel, which asks it to end in order; kill it when it does not."""
        self.channel.close()
        try:
            self.process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self.kill()
