"""Commands: on their way into the loop, and, once a cycle has taken them, to the log as inputs of the run.

A command is for one controller, or for the loop itself (its name is then LOOP): switch, rate, pause, resume,
load, unload, register, stop. Both are prepared and checked before they come here, and both are in the log.
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
"""Name of the addressee of a command that is for the loop itself; no controller can be called so."""

MOST_PER_CYCLE = 8
"""Commands that one cycle takes; the others wait for the next."""
LONGEST_COMMAND = 256 * 1024
"""Bytes of a command's record: a trajectory of some thousand points for twenty joints."""

_USUAL_COMMAND = 512
_NUMBER = 8
"""Bytes of a float64."""


class Command(msgspec.Struct, frozen=True, array_like=True, tag_field="is", tag=1):
    """A request to a controller, or to the loop."""

    number: int
    """The sender's; the answer names it."""
    controller: str
    kind: str
    data: bytes
    """For a controller what its `prepare` made, little-endian float64; for the loop JSON (UTF-8), for `play`
    with a line break and such an array behind it."""
    origin: str
    """The client, for the log."""
    lease_ns: Annotated[int, msgspec.Meta(ge=0)] = 0
    """For how long it counts unless another one follows, ns; 0: for ever."""
    request: bytes = b""
    """What `prepare` made the data of, for the log: the command as JSON, for `play` a list of all; empty:
    nothing was prepared, or it was too long."""


class TakenCommand(msgspec.Struct, frozen=True, array_like=True, tag_field="is", tag=2):
    """One command that a cycle took: for a controller, active or not, or for the loop itself."""

    t_ns: int
    """Time of the cycle's wake-up, ns of the run's clock."""
    cycle: int
    planned: int
    """Number of the command in the plan's commands, whose array it is; -1: the array is `data`."""
    controller: str
    """Empty: the loop itself."""
    kind: str
    origin: str
    """The client, or the place in a motion file."""
    data: bytes
    """As in Command; empty for a planned command."""
    lease_ns: int = 0
    """For how long a set-point of a stream counts; 0: for ever."""
    request: bytes = b""
    """As in Command; empty for a planned command."""

    @property
    def for_loop(self) -> bool:
        """True where no controller but the loop itself is meant."""
        return not self.controller

    @property
    def text(self) -> str:
        """The data as the log's text: JSON for the loop, hexadecimal for what is no array of numbers, else
        empty. Bytes that are no UTF-8 become escapes that no JSON has: what was refused stays refused."""
        if self.for_loop:
            return self.data.partition(b"\n")[0].decode(errors="backslashreplace")
        return self.data.hex() if len(self.data) % _NUMBER else ""

    @property
    def numbers(self) -> NDArray[np.float64]:
        """The data as the log's array; empty where it is the text."""
        data = self.data.partition(b"\n")[2] if self.for_loop else self.data
        return np.frombuffer(data if len(data) % _NUMBER == 0 else b"", dtype="<f8")


class ClientCommand(msgspec.Struct, frozen=True):
    """One command that is not in the plan."""

    command: TakenCommand
    refusal: str  # Why nothing was done; empty where it was done, or where the event with the refusal is lost


def data_of(controller: str, text: str, numbers: NDArray[np.float64]) -> bytes:
    """Return a command's data from its text and its array in the log. Raises ValueError when neither fits."""
    if controller and text:
        return bytes.fromhex(text)
    if controller:
        return numbers.tobytes()
    return text.encode() + (b"\n" + numbers.tobytes() if len(numbers) else b"")


class Inbox(Protocol):
    """Where the loop finds commands; never blocks, never raises."""

    def take(self) -> Sequence[Command]:
        """Return what has come, in order, at most MOST_PER_CYCLE and the newest set-point of each stream."""
        ...

    def answer(self, number: int, answer: Answer) -> None:
        """Answer a command by its number; after `Waiting` another answer follows."""
        ...


class NoInbox:
    """The inbox of a loop that takes no commands from outside."""

    def take(self) -> Sequence[Command]:
        """Return nothing."""
        return ()

    def answer(self, number: int, answer: Answer) -> None:
        """Forget it: no command came from here."""


class QueueInbox:
    """Commands from the same process, on virtual time; `answers` has the newest answer to each number."""

    def __init__(self) -> None:
        self.waiting: deque[Command] = deque()
        self.answers: dict[int, Answer] = {}

    def take(self) -> Sequence[Command]:
        """Return what has been put into `waiting`."""
        if not self.waiting:
            return ()
        return [self.waiting.popleft() for _ in range(min(len(self.waiting), MOST_PER_CYCLE))]

    def answer(self, number: int, answer: Answer) -> None:
        """Keep the answer."""
        self.answers[number] = answer


class CommandSink(Protocol):
    """Takes the commands that cycles took; never blocks, never raises."""

    def take(self, command: TakenCommand) -> None:
        """Record one command."""
        ...


class NoCommands:
    """Forgets commands: a run without a log, a replay."""

    def take(self, command: TakenCommand) -> None:
        """Forget it."""


class CommandRing:
    """Appends the commands that cycles took to a ring."""

    __slots__ = ("_writer",)

    def __init__(self, writer: Appender) -> None:
        self._writer = writer

    def take(self, command: TakenCommand) -> None:
        """Append one command."""
        self._writer.append(RecordKind.TAGGED, msgspec.msgpack.encode(command))


def encode_command(command: Command, most: int = LONGEST_COMMAND) -> bytes:
    """Return the record of a command on its way to the loop; without its request where it would be longer
    than `most`."""
    record = msgspec.msgpack.encode(command)
    if command.request and len(record) > most:
        record = msgspec.msgpack.encode(replace(command, request=b""))
    return record


def command_capacity(period_ns: int, controllers: int, mailbox: int) -> int:
    """Return how many bytes of a ring hold 10 s in which every controller takes a command in each cycle.

    Beside them there is room for everything that a full mailbox of so many bytes gives at once.
    """
    commands = RING_SECONDS * 1_000_000_000 // period_ns * controllers
    return commands * record_size(_USUAL_COMMAND) + mailbox
