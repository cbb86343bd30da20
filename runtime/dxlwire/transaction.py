"""Transaction: one instruction packet with the replies that are expected, and the reply that came."""

from __future__ import annotations

from collections.abc import Generator
from enum import IntEnum, unique
from typing import Generic, NamedTuple, Protocol, TypeAlias, TypeVar

import msgspec
from msgspec.structs import replace

Result = TypeVar("Result")

BROADCAST_ID = 0xFE
NO_REGISTER = -1  # In place of an address: the status acknowledges an instruction that may change registers
PRESENCE = -2  # In place of an address: the status answers a ping


class Status(NamedTuple):
    """Parsed status packet, the reply of a servo; a tuple for speed, because the loop creates one for
    every reply."""

    servo_id: int
    error: int  # Protocol-specific; `describe_error` formats it
    parameters: bytes | memoryview


class ExpectedReply(msgspec.Struct, frozen=True):
    """One status packet that is expected as a reply to an instruction."""

    servo_id: int
    length: int  # Number of its parameter bytes, without stuffing
    address: int = NO_REGISTER  # Address of the parameters, or one of the constants above


class Transaction(msgspec.Struct, frozen=True):
    """One instruction packet to send, with the replies to await, their due time and timeout."""

    packet: bytes
    servo_id: int  # The servo that the instruction addresses
    awaited: tuple[ExpectedReply, ...]  # Expected replies, in the order of their arrival; may be empty
    due_ns: int
    """Time from the start of the write to the last byte of all replies on the wire; without replies the
    time of the instruction on the wire."""
    timeout_ns: int  # Timeout from the start of the write; 0 without replies
    widest: int = 0  # Size of the longest possible reply on the line, including stuffing
    # True if all servos share one status packet of the broadcast ID, which has no stuffing
    fast: bool = False
    tail: int = 0
    """Number of last replies, those of devices, with a short timeout, which starts once all replies before
    them have arrived: until `tail_timeout_ns` from the start of the write, and `tail_margin_ns` after
    the last of those replies."""
    tail_timeout_ns: int = 0
    tail_margin_ns: int = 0
    spare: int = 0
    """Readable bytes after the requested ones, for a read of one servo. While a late reply to an older
    request would fit, the read asks for more of them."""
    patience_ns: int = 1 << 62
    """Longest time (ns) to hold the transaction back while a late reply to an older request could be taken
    for its own."""
    any_age: bool = False
    """True if a late reply to an older read of the same registers is valid, even after a write between the
    two."""


@unique
class TransactionOutcome(IntEnum):
    """Outcome of a transaction. A lost packet is not an exception."""

    SENT = 0  # No reply was expected
    OK = 1  # All expected replies arrived
    TIMEOUT = 2  # An expected reply is missing, and nothing else arrived
    GARBLED = 3  # Bytes arrived, but not the expected ones
    REFUSED = 4  # The servo answered with an error and without the data


class Reply(msgspec.Struct):
    """Result of a transaction that was executed; if it had several status packets, values of the newest one.

    A program receives it from `yield`. A lost reply to a write does not show whether the write was executed,
    and nothing repeats it. A program must treat only writes that were `answered` as done.

    A bus reuses one object for all its transactions, so a job must copy the values before it continues.
    Programs get their own objects."""

    outcome: TransactionOutcome
    error: int  # Error byte of the status packet
    parameters: bytes | memoryview
    last_ns: int  # Time of the read() that returned the last byte of the status packet
    strays: int  # Unexpected intact packets and runs of noise since the transaction before
    echoed: bool  # True if the instruction itself came back: the adapter echoes
    sent_ns: int = 0  # Start of the write of the instruction
    asked_ns: int = 0  # Start of the write of the oldest repetition that this reply may answer
    stalled_ns: int = 0  # Part of the lateness for which simulated servos had no processor

    @property
    def answered(self) -> bool:
        """True if all expected status packets arrived, without a refusal."""
        return self.outcome is TransactionOutcome.OK

    def word(self, size: int = 2, offset: int = 0) -> int:
        """Return the unsigned little-endian integer of `size` bytes at `offset` in the parameters."""
        return int.from_bytes(self.parameters[offset : offset + size], "little")


Program: TypeAlias = Generator[Transaction, Reply, Result]
"""Generator of transactions, executed on one bus: yields each transaction and receives its reply, on which
later transactions may depend. It returns a result."""


class Job(Protocol):
    """Sequence of transactions that a `Bus` executes one after the other."""

    def next_transaction(self, reply: Reply | None) -> Transaction | None:
        """Process the reply to the last transaction (None at the start), and return the next transaction;
        None at the end."""
        ...

    def status(self, index: int, reply: Reply) -> None:
        """Process one status packet of the current transaction, the one expected at `index`. The reply
        object is valid only during the call."""
        ...


class ProgramJob(Generic[Result]):
    """Job that executes a program; for set-up, probes and shutdown, where the cost of allocations does not
    matter."""

    __slots__ = ("_program", "result")

    def __init__(self, program: Program[Result]) -> None:
        self._program = program
        self.result: Result | None = None
        """Return value of the program; None until the program has ended."""

    def status(self, index: int, reply: Reply) -> None:
        """Ignore the single status packet: `next_transaction` receives the whole reply, and a program awaits
        one status at a time."""

    def next_transaction(self, reply: Reply | None) -> Transaction | None:
        """Resume the program with a copy of the reply; return its next transaction, None after the last
        one."""
        try:
            if reply is None:
                return next(self._program)
            return self._program.send(replace(reply, parameters=bytes(reply.parameters)))
        except StopIteration as end:
            self.result = end.value
            return None
