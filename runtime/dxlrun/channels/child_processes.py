"""Processes of a run: start of child processes, shared memory, and typed messages between processes."""

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
"""Timeout for a child's first message. A cold import of numpy takes a second."""
END_TIMEOUT_S = 10.0
"""Timeout for the exit of a child. A recorder on a slow disk restarts it with a message after each step."""

_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment that stops numpy from starting a thread for each core on import."""
_LINE_LIMIT = 1 << 20  # bytes; a longer incomplete message closes the channel
_MOST_DESCRIPTORS = 64  # in one receive


def spare_core(taken: Collection[int]) -> int:
    """Return the last core that this process may use and that is not in `taken`, else the last one."""
    allowed = os.sched_getaffinity(0)
    return max(allowed.difference(taken) or allowed)


def start_module(
    module: str, arguments: Sequence[str], descriptors: Iterable[int], errors: int
) -> subprocess.Popen[bytes]:
    """Execute `python -m module` in a session of its own, so that a terminal's Ctrl-C does not reach it.

    `-P` keeps the working directory out of the import path: a `numpy.py` next to the robot file must not be
    imported.

    Args:
        module: The module.
        arguments: Command line arguments.
        descriptors: File descriptors that the process inherits.
        errors: Descriptor for stdout and stderr, which only --debug shows.
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
    """Return the descriptor of an anonymous file (memfd) with `content`."""
    descriptor = os.memfd_create(name)
    os.pwrite(descriptor, content, 0)
    return descriptor


def whole(descriptor: int) -> bytes:
    """Return the whole content of an anonymous file (memfd), regardless of its offset."""
    return os.pread(descriptor, os.fstat(descriptor).st_size, 0)


class LimitedTextStream(io.TextIOBase):
    """Text stream with a size limit for a process' output, so that printing plug-ins fill no memory.

    Args:
        descriptor: Anonymous file with the process' output, see `start_module`; --debug shows it.
        most: Size limit, bytes.
    """

    def __init__(self, descriptor: int, most: int = 1 << 20) -> None:
        super().__init__()
        self._descriptor = descriptor
        self._room = most

    def writable(self) -> bool:
        """Return True."""
        return True

    def fileno(self) -> int:
        """Return the descriptor of the file."""
        return self._descriptor

    def write(self, text: str, /) -> int:
        """Write the text as far as the limit allows, and ignore the rest. Never raises."""
        data = text.encode(errors="replace")[: self._room]
        self._room -= len(data)
        with suppress(OSError):
            os.write(self._descriptor, data)
            if data and not self._room:
                os.write(self._descriptor, b"\n(later output is omitted)\n")
        return len(text)


@dataclass(frozen=True, slots=True)
class RunMemory:
    """Descriptors of the memory files that the processes of a run share, by purpose.

    The memory is freed when the last process exits.
    """

    plan: int
    heartbeat: int
    cycles: int
    packets: int
    desk: int
    """Memory with the packets of the cycle that is not complete."""
    events: int
    """Ring with the loop's events and executed commands."""
    messages: int
    """Ring with the loop's topics and their messages."""
    guardian: int
    """Ring with packets and events of the guardian process."""
    result: int
    """File in which the loop leaves its result."""
    mailbox: int
    answers: int
    grants: int
    """File with the results of the loop's real-time requests."""
    stderr: int
    kept: int
    """File with states that controllers kept in earlier runs."""
    span: int
    """Range of cycles that the log has on the disk, updated by the recorder at each flush."""
    slots: dict[str, tuple[int, ...]] = field(default_factory=dict)
    """Slots for the samples of source processes, by name of the feature."""
    shafts: int = -1
    """Slot of the shafts of simulated servos, for processes that sense the simulated body; -1: none."""
    simulation: int = -1
    """Memory with the progress of simulated servos; -1: no bus is simulated."""

    @property
    def of_loop(self) -> tuple[int, ...]:
        """Descriptors that the loop's process inherits."""
        rings = (self.cycles, self.packets, self.desk, self.events, self.messages, self.mailbox, self.answers)
        simulated = (self.simulation,) if self.simulation >= 0 else ()
        own = (self.result, self.grants, self.kept, *chain(*self.slots.values()), *simulated)
        return (self.plan, self.heartbeat, *rings, *own)

    @property
    def recorded(self) -> dict[str, int]:
        """Rings that the recorder reads, by their name in reports of missing records."""
        return {
            "loop/cycles": self.cycles,
            "loop/packets": self.packets,
            "loop/events": self.events,
            "loop/messages": self.messages,
            "guardian": self.guardian,
        }


class Failed(msgspec.Struct, frozen=True, tag=True):
    """Message of any process: it cannot start or continue, for the reason in the sentence."""

    sentence: str


class Stop(msgspec.Struct, frozen=True, tag=True):
    """Message from terminal to guardian: stop the robot by its exit policy."""


class Cut(msgspec.Struct, frozen=True, tag=True):
    """Message from terminal to guardian: kill the loop and cut the servos' torque at once."""


class LineLost(msgspec.Struct, frozen=True, tag=True):
    """Loop to guardian, which forwards it to the terminal: the port of a bus is gone; close it."""

    bus: int
    """Index in the plan's buses."""


class LineReturned(msgspec.Struct, frozen=True, tag=True):
    """Message from guardian to loop and terminal: the port of a bus is open again.

    Its descriptor is attached.
    """

    bus: int


class Finish(msgspec.Struct, frozen=True, tag=True):
    """Message from supervisor to recorder: read all remaining records and close the log."""


class LateMetadata(msgspec.Struct, frozen=True, tag=True):
    """Supervisor to recorder: metadata for the end of the log."""

    records: dict[str, dict[str, str]]


class LoopRuns(msgspec.Struct, frozen=True, tag=True):
    """Supervisor to recorder: process ID of the loop, whose processor load is logged."""

    pid: int


class Ready(msgspec.Struct, frozen=True, tag=True):
    """Message from recorder to supervisor: the log file is open."""


class Draining(msgspec.Struct, frozen=True, tag=True):
    """Message from recorder to supervisor: it still reads the remaining records, so the wait continues."""


class Listening(msgspec.Struct, frozen=True, tag=True):
    """Gateway to supervisor: clients can connect."""

    socket: str
    """Path of the socket."""


Received = TypeVar("Received")


class MessageChannel(Generic[Received]):
    """One end of a message channel between two processes: JSON, one message a line."""

    def __init__(self, end: socket.socket, received: msgspec.json.Decoder[Received]) -> None:
        self._socket = end
        self._decoder = received
        self._pending = b""
        self.closed = False
        """True after the other end was closed and its last message was read."""
        self.descriptors: list[int] = []
        """Descriptors received with messages so far; the caller removes them."""

    def fileno(self) -> int:
        """Return the socket's descriptor for select."""
        return self._socket.fileno()

    def send_message(self, message: object, descriptors: Sequence[int] = ()) -> None:
        """Send a message with open descriptors. Never raises.

        `receive_messages` detects a closed channel, after it has returned the last messages of the other end.
        """
        data = msgspec.json.encode(message) + b"\n"
        with suppress(OSError):
            if descriptors:
                socket.send_fds(self._socket, [data], descriptors)
            else:
                self._socket.sendall(data)

    def receive_messages(self) -> list[Received]:
        """Wait for data; return the complete messages, possibly none.

        Sets `closed` at the end of the stream.
        """
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
        """Close this end of the channel, which the other end detects."""
        self._socket.close()


def message_channel(
    received: msgspec.json.Decoder[Received],
) -> tuple[MessageChannel[Received], socket.socket]:
    """Return this process' end of a new channel and the child's end, to be closed after the child's start."""
    ours, theirs = socket.socketpair()
    return MessageChannel(ours, received), theirs


Job = TypeVar("Job")
_PR_SET_PDEATHSIG = 1


def begun(job: type[Job], received: msgspec.json.Decoder[Received]) -> tuple[Job, MessageChannel[Received]]:
    """Set up this process as a `Child` with the arguments `--job-fd N ... --control-fd M`.

    SIGINT is ignored: only the supervisor handles Ctrl-C.

    Args:
        job: Type of the job, which is JSON in the file N.
        received: Decoder for messages from the parent.

    Returns:
        The job, and this end of the channel M.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    found = msgspec.json.decode(whole(int(sys.argv[2])), type=job)
    return found, MessageChannel(socket.socket(fileno=int(sys.argv[-1])), received)


def hold_foreign_code(number: signal.Signals) -> None:
    """Limit the output of plug-ins, and let this process get the signal when its parent exits (prctl(2))."""
    sys.stdout = sys.stderr = LimitedTextStream(sys.stderr.fileno())
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)


class Child(Generic[Received]):
    """A child process of the run and the message channel to it."""

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

    def next_message(self, timeout_s: float) -> Received | None:
        """Wait for the next message of the child; return None if it has closed its end of the channel.

        Raises:
            ProcessFault: No message arrived within the timeout.
        """
        while not self._messages and not self.channel.closed:
            ready, _, _ = select.select([self.channel], [], [], timeout_s)
            if not ready:
                raise ProcessFault(f"the {self.name} did not answer for {timeout_s:.0f} s")
            self._messages.extend(self.channel.receive_messages())
        return self._messages.popleft() if self._messages else None

    def poll_message(self, timeout_s: float, *others: int) -> Received | None:
        """Return a message of the child that arrives within a timeout, or None.

        Args:
            timeout_s: Timeout.
            others: Descriptors that end the wait when they are ready.
        """
        if not self._messages:
            ready, _, _ = select.select([self.channel.fileno(), *others], [], [], timeout_s)
            if self.channel.fileno() in ready:
                self._messages.extend(self.channel.receive_messages())
        return self._messages.popleft() if self._messages else None

    def ready(self) -> Received:
        """Wait for the child's first message, which reports that it has started, and return it.

        Raises:
            ProcessFault: The child exited, or sent no message in time.
            PortError: The message is `Failed`.
        """
        message = self.next_message(START_TIMEOUT_S)
        if message is None:
            code = self.process.wait(END_TIMEOUT_S)
            raise ProcessFault(f"the {self.name} exited during start-up (exit code {code}); try --debug")
        if isinstance(message, Failed):
            raise PortError(message.sentence)
        return message

    def exited(self, timeout_s: float = 0.0) -> bool:
        """Return whether the child exits within a timeout, s.

        It is not reaped, so its PID is not used again.
        """
        if self.process.returncode is not None:
            return True
        descriptor = os.pidfd_open(self.process.pid)
        try:
            return bool(select.select([descriptor], [], [], timeout_s)[0])
        finally:
            os.close(descriptor)

    def kill(self) -> None:
        """Kill the child and its process group, reap the child, and close the channel."""
        if self.process.returncode is None:
            with suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
        self.channel.close()

    def end_process(self) -> None:
        """Ask the child to exit by closing the channel, and wait; kill it after a timeout."""
        self.channel.close()
        try:
            self.process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self.kill()
