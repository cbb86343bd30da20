"""Commands: their records in the loop's inbox, and in the log as inputs of the run.

A command is for one controller or for the loop itself, with LOOP as the name: switch, rate, pause, resume,
load, unload, register, stop. The sender prepares and checks both kinds, and both are logged.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Annotated, Protocol

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dxlrun.channels.answers import Answer
from dxlrun.channels.ring import RING_SECONDS, Appender, RecordKind, record_size

LOOP = ""
"""Controller name that addresses a command to the loop itself; not a valid name of a controller."""
OWN_ORIGIN = "loop"
"""Origin of commands that the run sends itself, such as the pause of a start."""

MOST_PER_CYCLE = 8
"""Most client commands that the loop executes in a cycle; more wait for the next one."""
LONGEST_COMMAND = 256 * 1024
"""Longest record of a command, bytes: a trajectory of some thousand points for twenty joints."""

_USUAL_COMMAND = 512  # bytes of a typical record, for the capacity of rings
_NUMBER = 8
"""Size of a float64, bytes."""


class CommandMessage(msgspec.Struct, frozen=True, array_like=True, tag_field="is", tag=1):
    """A client command for a controller or for the loop, as a record in the loop's inbox."""

    number: int
    """Number that the sender assigns; the answer repeats it."""
    controller: str
    kind: str
    data: bytes
    """Little-endian float64 values from the controller's `prepare`. For the loop, JSON (UTF-8); for `play`,
    JSON, a line break and an array."""
    origin: str
    """Client that sent the command, for the log."""
    lease_ns: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Time after which the command expires unless another one follows, ns; 0: it does not expire."""
    request: bytes = b""
    """Input of `prepare` for the log: the command as JSON, for `play` a list. Empty if nothing was prepared,
    or if it was too long."""


class TakenCommand(msgspec.Struct, frozen=True, array_like=True, tag_field="is", tag=2):
    """A command that a cycle has executed or refused, as a record for the log."""

    t_ns: int
    """Time of the cycle's wake-up, ns of the run's clock."""
    cycle: int
    planned: int
    """Index of the command in the plan, which has its data; -1: a client's command, with its data in `data`.
    """
    controller: str
    """Name of the controller; empty: the command is for the loop itself."""
    kind: str
    origin: str
    """Client that sent the command, or its position in a motion file."""
    data: bytes
    """As in Command; empty for a planned command."""
    lease_ns: int = 0
    """Time after which the command of a stream expires, ns; 0: it does not expire."""
    request: bytes = b""
    """As in Command; empty for a planned command."""

    @property
    def for_loop(self) -> bool:
        """True if the command is for the loop itself."""
        return not self.controller

    @property
    def data_text(self) -> str:
        """Text in the command's data: JSON for the loop, hexadecimal if not an array, else empty.

        Invalid UTF-8 becomes escapes that are invalid in JSON, so a replay refuses the command again.
        """
        if self.for_loop:
            return self.data.partition(b"\n")[0].decode(errors="backslashreplace")
        return self.data.hex() if len(self.data) % _NUMBER else ""

    @property
    def numbers(self) -> NDArray[np.float64]:
        """Array of float64 in the command's data; empty if `text` has the data."""
        data = self.data.partition(b"\n")[2] if self.for_loop else self.data
        return np.frombuffer(data if len(data) % _NUMBER == 0 else b"", dtype="<f8")


class ClientCommand(msgspec.Struct, frozen=True):
    """A logged command that a client sent in the run, not one of the plan, with its refusal."""

    command: TakenCommand
    refusal: str  # Text of the refusal; empty on success, or if the event with the refusal was lost


def data_of(controller: str, text: str, numbers: NDArray[np.float64]) -> bytes:
    """Return a command's data from the text and array that the log has.

    Raises ValueError for invalid text.
    """
    if controller and text:
        return bytes.fromhex(text)
    if controller:
        return numbers.tobytes()
    return text.encode() + (b"\n" + numbers.tobytes() if len(numbers) else b"")


class Inbox(Protocol):
    """Source of commands for the loop. Its methods never block and never raise."""

    def drain_commands(self) -> Sequence[CommandMessage]:
        """Return new commands in the order of arrival: at most MOST_PER_CYCLE, and the newest setpoint of
        each stream."""
        ...

    def answer_command(self, number: int, answer: Answer) -> None:
        """Send the answer to a command, by its number. After `Acceptance`, another answer follows."""
        ...


class NoInbox:
    """Inbox of a loop without clients."""

    def drain_commands(self) -> Sequence[CommandMessage]:
        """Return no commands."""
        return ()

    def answer_command(self, number: int, answer: Answer) -> None:
        """Do nothing."""


class QueueInbox:
    """Inbox for client commands from the same process, on virtual time.

    `answers` has the newest answer to each command by its number.
    """

    def __init__(self) -> None:
        self.waiting: deque[CommandMessage] = deque()
        self.answers: dict[int, Answer] = {}

    def drain_commands(self) -> Sequence[CommandMessage]:
        """Return the commands that were put into `waiting`, at most MOST_PER_CYCLE, oldest first."""
        if not self.waiting:
            return ()
        return [self.waiting.popleft() for _ in range(min(len(self.waiting), MOST_PER_CYCLE))]

    def answer_command(self, number: int, answer: Answer) -> None:
        """Store the answer in `answers`, in place of an earlier one."""
        self.answers[number] = answer


class CommandSink(Protocol):
    """Destination for a record of each command that a cycle executed, such as the log.

    Never blocks or raises.
    """

    def record_command(self, command: TakenCommand) -> None:
        """Record one executed or refused command."""
        ...


class NoCommands:
    """Command sink that discards the records, for runs without a log."""

    def record_command(self, command: TakenCommand) -> None:
        """Do nothing."""


class CommandRing:
    """Command sink that appends executed commands to a ring in shared memory, for the recorder."""

    __slots__ = ("_writer",)

    def __init__(self, writer: Appender) -> None:
        self._writer = writer

    def record_command(self, command: TakenCommand) -> None:
        """Append one executed command to the ring."""
        self._writer.append(RecordKind.TAGGED, msgspec.msgpack.encode(command))


def encode_command(command: CommandMessage, most: int = LONGEST_COMMAND) -> bytes:
    """Encode a client command as a record; omit its `request` if the record were longer than `most` bytes."""
    record = msgspec.msgpack.encode(command)
    if command.request and len(record) > most:
        record = msgspec.msgpack.encode(replace(command, request=b""))
    return record


def command_capacity(period_ns: int, controllers: int, mailbox: int) -> int:
    """Return the ring size, bytes, for 10 s with a command for every controller in each cycle.

    Args:
        period_ns: Period of the loop.
        controllers: Number of controllers.
        mailbox: Additional room for the records of a full mailbox, bytes.
    """
    commands = RING_SECONDS * 1_000_000_000 // period_ns * controllers
    return commands * record_size(_USUAL_COMMAND) + mailbox
