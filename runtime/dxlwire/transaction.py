"""A prepared exchange on a bus: the bytes that go out, and what is awaited."""

from __future__ import annotations

from collections.abc import Generator
from enum import IntEnum, unique
from typing import Generic, NamedTuple, Protocol, TypeAlias, TypeVar

import msgspec
from msgspec.structs import replace

Result = TypeVar("Result")

BROADCAST_ID = 0xFE
NO_REGISTER = -1  # Instead of an address: the status acknowledges an instruction that may change registers
PRESENCE = -2  # Instead of an address: the status answers a ping


class Status(NamedTuple):
    """An intact status packet, taken apart; a tuple, because the loop makes one for every reply."""

    servo_id: int
    error: int  # What it means is the protocol's: `describe_error` has the words
    parameters: bytes | memoryview


class Awaited(msgspec.Struct, frozen=True):
    """One status packet that is due after an instruction."""

    servo_id: int
    length: int  # Number of its parameter bytes, without stuffing
    address: int = NO_REGISTER  # The first register that they have, or one of the constants above


class Transaction(msgspec.Struct, frozen=True):
    """One instruction packet and the shape of its replies."""

    packet: bytes
    servo_id: int  # The servo that the instruction addresses
    awaited: tuple[Awaited, ...]  # The replies, in their order; empty: there is none
    due_ns: int
    """From the start of the write to the last byte of all replies, by the wire; without: the wire time."""
    timeout_ns: int  # From the start of the write to giving up; 0 without reply
    widest: int = 0  # The most bytes that one of the replies has on the line, stuffing included
    fast: bool = False  # All that answer share one status packet of the broadcast ID, which is not stuffed
    tail: int = 0
    """How many of the replies, the last ones, are awaited briefly once the others came: until
    `tail_timeout_ns` from the start of the write, and `tail_margin_ns` from the last of the others."""
    tail_timeout_ns: int = 0
    tail_margin_ns: int = 0
    spare: int = 0
    """Bytes after those of a read of one servo that can be read with it. While the late reply to an older
    request would fit, a read asks for more of them."""
    patience_ns: int = 1 << 62
    """How long the transaction may be held back while the late reply to an older request would fit."""
    any_age: bool = False
    """The late reply to an older read of the same registers counts, even if a write came between."""


@unique
class Outcome(IntEnum):
    """What came of a transaction; a lost packet is data, not an exception."""

    SENT = 0  # No reply was awaited
    OK = 1  # Everything that was awaited came
    TIMEOUT = 2  # Something awaited did not come, and nothing else did
    GARBLED = 3  # Bytes came, but not what was awaited
    REFUSED = 4  # The servo answered with an error and without the data


class Reply(msgspec.Struct):
    """What came of a transaction; of several statuses it shows the newest.

    A program gets it from `yield`. A write may be lost, or done without an acknowledgement that arrives:
    nothing repeats it, so a program keeps only what was `answered` as written.

    A bus reuses one object for all its transactions, so a job takes what it needs before it continues;
    programs get their own.
    """

    outcome: Outcome
    error: int  # Error byte of the status packet
    parameters: bytes | memoryview
    last_ns: int  # Time of the read() that brought the last byte of the status packet
    strays: int  # Intact packets that were not awaited, and bytes of noise, since the transaction before
    echoed: bool  # True when the instruction itself came back: the adapter echoes
    sent_ns: int = 0  # Start of the write of the instruction
    asked_ns: int = 0  # The same of its oldest repetition whose late reply this may be
    stalled_ns: int = 0  # By how much it is late because simulated servos had no processor

    @property
    def answered(self) -> bool:
        """True when the awaited status packet came."""
        return self.outcome is Outcome.OK

    def word(self, size: int = 2, offset: int = 0) -> int:
        """Return a little-endian item out of the parameters."""
        return int.from_bytes(self.parameters[offset : offset + size], "little")


Program: TypeAlias = Generator[Transaction, Reply, Result]
"""A sequence of transactions that decides as it goes: yields each one, is sent what came of it."""


class Job(Protocol):
    """What a bus executes: transactions one after the other."""

    def advance(self, reply: Reply | None) -> Transaction | None:
        """Take what came of the transaction before (None at the start), return the next; None: finished."""
        ...

    def status(self, index: int, reply: Reply) -> None:
        """Take the status that the transaction awaits at `index`; the reply is good during the call."""
        ...


class ProgramJob(Generic[Result]):
    """Executes a program; for set-up, probes and shutdown, where a few objects a transaction do no harm."""

    __slots__ = ("_program", "result")

    def __init__(self, program: Program[Result]) -> None:
        self._program = program
        self.result: Result | None = None
        """What the program returned; None until it did."""

    def status(self, index: int, reply: Reply) -> None:
        """Wait for the end of the transaction: a program awaits one status at a time."""

    def advance(self, reply: Reply | None) -> Transaction | None:
        """Resume the program."""
        try:
            if reply is None:
                return next(self._program)
            return self._program.send(replace(reply, parameters=bytes(reply.parameters)))
        except StopIteration as end:
            self.result = end.value
            return None
