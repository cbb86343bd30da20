"""Commands on their way to the log: what cycles took for controllers and the loop; an input of the run."""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dxlrun.run.channels.ring import RING_SECONDS, Appender, Payload

COMMAND_SLOT = 512
"""Bytes of one slot of a commands' ring; a longer array takes several slots."""

_HEADER = struct.Struct("<qqqqIIHHH2x")
_LONGEST_NAME = 64
_FULL_MAILBOX = 5 * 1024
"""Slots: 1 MiB of commands with the longest names (272 bytes a slot), and a long set-point of 63 streams."""
_NUMBER = 8
"""Bytes of a float64."""


@dataclass(frozen=True, slots=True)
class TakenCommand:
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
    """Who asked."""
    data: bytes
    """Little-endian float64, for the loop JSON; empty for a planned command."""
    lease_ns: int = 0
    """For how long a set-point of a stream counts; 0: for ever."""

    @property
    def for_loop(self) -> bool:
        """True where no controller but the loop itself is meant."""
        return not self.controller

    @property
    def text(self) -> str:
        """The data as the log's text: JSON for the loop, hexadecimal for what is no array of numbers, else
        empty. Bytes that are no UTF-8 become escapes that no JSON has: what was refused stays refused."""
        if self.for_loop:
            return self.data.decode(errors="backslashreplace")
        return self.data.hex() if len(self.data) % _NUMBER else ""

    @property
    def numbers(self) -> NDArray[np.float64]:
        """The data as the log's array; empty where it is the text."""
        whole = not self.for_loop and len(self.data) % _NUMBER == 0
        return np.frombuffer(self.data if whole else b"", dtype="<f8")


def data_of(controller: str, text: str, numbers: NDArray[np.float64]) -> bytes:
    """Return a command's data from its text and its array in the log. Raises ValueError when neither fits."""
    if controller and text:
        return bytes.fromhex(text)
    return numbers.tobytes() if controller else text.encode()


class CommandSink(Protocol):
    """Takes what cycles took; never blocks, never raises."""

    def take(self, command: TakenCommand) -> None:
        """Record one command."""
        ...


class NoCommands:
    """Forgets commands: a run without a log, a replay."""

    def take(self, command: TakenCommand) -> None:
        """Forget it."""


class CommandRing:
    """Appends commands to a ring, cut into slots; the number of slots grows only with the array."""

    __slots__ = ("_writer",)

    def __init__(self, writer: Appender) -> None:
        self._writer = writer

    def take(self, command: TakenCommand) -> None:
        """Append one command; names are cut at 64 bytes (the origin keeps its end, where the line is)."""
        controller = command.controller.encode(errors="replace")[:_LONGEST_NAME]
        kind = command.kind.encode(errors="replace")[:_LONGEST_NAME]
        origin = command.origin.encode(errors="replace")[-_LONGEST_NAME:]
        names = controller + kind + origin
        room = self._writer.slot_size - _HEADER.size - len(names)
        pieces = max(1, -(-len(command.data) // room))
        lengths = len(controller), len(kind), len(origin)
        for part in range(pieces):
            head = _HEADER.pack(
                command.t_ns,
                command.cycle,
                command.planned,
                command.lease_ns,
                part,
                pieces - part - 1,
                *lengths,
            )
            self._writer.append(head + names + command.data[part * room : (part + 1) * room])


class CommandPieces:
    """Puts the records of a commands' ring together again."""

    __slots__ = ("_parts", "_pieces")

    def __init__(self) -> None:
        self._pieces: list[bytes] = []
        self._parts = 0

    def add(self, payload: Payload) -> TakenCommand | None:
        """Take one record; return the command that it completes.

        Raises ValueError when a record is none, or does not follow the one before: some were lost.
        """
        command, part, remaining = _decode(payload)
        expected, self._parts = self._parts, part + 1 if remaining else 0
        if part == 0:
            self._pieces.clear()
        elif part != expected or not self._pieces:
            self._pieces.clear()
            self._parts = 0
            raise ValueError("a piece of a command came without those before it")
        self._pieces.append(command.data)
        if remaining:
            return None
        data = b"".join(self._pieces)
        self._pieces.clear()
        return replace(command, data=data)


def _decode(payload: Payload) -> tuple[TakenCommand, int, int]:
    try:
        t_ns, cycle, planned, lease_ns, part, remaining, *lengths = _HEADER.unpack_from(payload)
    except struct.error as error:
        raise ValueError(f"a command ends inside its header: {error}") from error
    data = bytes(payload[_HEADER.size :])
    if len(data) < sum(lengths):
        raise ValueError("a command is shorter than its names")
    names = []
    for length in lengths:
        names.append(data[:length].decode(errors="replace"))
        data = data[length:]
    controller, kind, origin = names
    return TakenCommand(t_ns, cycle, planned, controller, kind, origin, data, lease_ns), part, remaining


def command_slots(period_ns: int, controllers: int) -> int:
    """Return how many slots hold 10 s in which every controller takes a short command in each cycle.

    Beside them there is room for everything that a full mailbox gives one cycle: a command that overwrote its
    own beginning would never come whole into the log.
    """
    return _FULL_MAILBOX + RING_SECONDS * 1_000_000_000 // period_ns * controllers
