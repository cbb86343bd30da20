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
"""Name of the loop as the addressee of a command; not a valid name of a controller."""

MOST_PER_CYCLE = 8
"""Most commands in a cycle; more wait for the next one."""
LONGEST_COMMAND = 256 * 1024
"""Longest record of a command, bytes: a trajectory of some thousand points for twenty joints."""

_USUAL_COMMAND = 512  # bytes of a typical record, for the capacity of rings
_NUMBER = 8
"""Bytes of a float64."""


class Command(msgspec.Struct, frozen=True, array_like=True, tag_field="is", tag=1):
    """A request to a controller or to the loop."""

    number: int
    """Number that the sender assigns; the answer refers to it."""
    controller: str
    kind: str
    data: bytes
    """Little-endian float64 from the controller's `prepare`. For the loop, JSON (UTF-8); for `play`, JSON, a
    line break and an array."""
    origin: str
    """Client that sent the command, for the log."""
    lease_ns: Annotated[int, msgspec.Meta(ge=0)] = 0
    """Lease: time for which the command is valid unless another one follows, ns; 0: unlimited."""
    request: bytes = b""
    """Input of `prepare` for the log: the command as JSON, for `play` a list. Empty if nothing was prepared,
    or if it was too long."""


class TakenCommand(msgspec.Struct, frozen=True, array_like=True, tag_field="is", tag=2):
    """A command that a cycle has executed or refused, for a controller or for the loop."""

    t_ns: int
    """Time of the cycle's wake-up, ns of the run's clock."""
    cycle: int
    planned: int
    """Index in the plan's commands, which have the array; -1: the array is in `data`."""
    controller: str
    """Empty: the loop itself."""
    kind: str
    origin: str
    """The client, or the place in a motion file."""
    data: bytes
    """As in Command; empty for a planned command."""
    lease_ns: int = 0
    """Lease of a setpoint in a stream; 0: unlimited."""
    request: bytes = b""
    """As in Command; empty for a planned command."""

    @property
    def for_loop(self) -> bool:
        """True if the command is for the loop itself."""
        return not self.controller

    @property
    def text(self) -> str:
        """The data as text for the log: JSON for the loop, hexadecimal if they are not an array, else empty.

        Invalid UTF-8 becomes escapes that are invalid in JSON, so a replay refuses the command again.
        """
        if self.for_loop:
            return self.data.partition(b"\n")[0].decode(errors="backslashreplace")
        return self.data.hex() if len(self.data) % _NUMBER else ""

    @property
    def numbers(self) -> NDArray[np.float64]:
        """The array in the data for the log; empty if `text` has the data."""
        data = self.data.partition(b"\n")[2] if self.for_loop else self.data
        return np.frombuffer(data if len(data) % _NUMBER == 0 else b"", dtype="<f8")


class ClientCommand(msgspec.Struct, frozen=True):
    """A command that is not in the plan."""

    command: TakenCommand
    refusal: str  # Text of the refusal; empty on success, or if the event with the refusal was lost


def data_of(controller: str, text: str, numbers: NDArray[np.float64]) -> bytes:
    """Return a command's data from its text and its array in the log. Raises ValueError for invalid text."""
    if controller and text:
        return bytes.fromhex(text)
    if controller:
        return numbers.tobytes()
    return text.encode() + (b"\n" + numbers.tobytes() if len(numbers) else b"")


class Inbox(Protocol):
    """Source of commands for the loop. Its methods never block and never raise."""

    def take(self) -> Sequence[Command]:
        """Return new commands in the order of arrival: at most MOST_PER_CYCLE, and the newest setpoint of
        each stream."""
        ...

    def answer(self, number: int, answer: Answer) -> None:
        """Answer a command by its number. Another answer follows after `Waiting`."""
        ...


class NoInbox:
    """Inbox of a loop without clients."""

    def take(self) -> Sequence[Command]:
        """Return no commands."""
        return ()

    def answer(self, number: int, answer: Answer) -> None:
        """Do nothing."""


class QueueInbox:
    """Inbox for commands of the same process, on virtual time. `answers` has the last answer by number."""

    def __init__(self) -> None:
        self.waiting: deque[Command] = deque()
        self.answers: dict[int, Answer] = {}

    def take(self) -> Sequence[Command]:
        """Return the commands in `waiting`, at most MOST_PER_CYCLE."""
        if not self.waiting:
            return ()
        return [self.waiting.popleft() for _ in range(min(len(self.waiting), MOST_PER_CYCLE))]

    def answer(self, number: int, answer: Answer) -> None:
        """Store the answer."""
        self.answers[number] = answer


class CommandSink(Protocol):
    """Destination of executed commands. Never blocks and never raises."""

    def take(self, command: TakenCommand) -> None:
        """Record one command."""
        ...


class NoCommands:
    """Drops commands, for runs without a log."""

    def take(self, command: TakenCommand) -> None:
        """Do nothing."""


class CommandRing:
    """Appends executed commands to a ring."""

    __slots__ = ("_writer",)

    def __init__(self, writer: Appender) -> None:
        self._writer = writer

    def take(self, command: TakenCommand) -> None:
        """Append one command."""
        self._writer.append(RecordKind.TAGGED, msgspec.msgpack.encode(command))


def encode_command(command: Command, most: int = LONGEST_COMMAND) -> bytes:
    """Encode a command for the loop. The request is omitted if the record would be longer than `most`."""
    record = msgspec.msgpack.encode(command)
    if command.request and len(record) > most:
        record = msgspec.msgpack.encode(replace(command, request=b""))
    return record


def command_capacity(period_ns: int, controllers: int, mailbox: int) -> int:
    """Return the capacity of a ring, bytes, for 10 s with a command for every controller in each cycle.

    Args:
        period_ns: Period of the loop.
        controllers: Number of controllers.
        mailbox: Additional room for the records of a full mailbox, bytes.
    """
    commands = RING_SECONDS * 1_000_000_000 // period_ns * controllers
    return commands * record_size(_USUAL_COMMAND) + mailbox
