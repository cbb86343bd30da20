"""Line: the times of one serial line, and the transactions that are made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
from msgspec.structs import replace

from dxlwire.transaction import BROADCAST_ID, PRESENCE, Awaited, Transaction
from dxlwire.wire import protocol1
from dxlwire.wire.dialect import Dialect

BITS_PER_BYTE = 10  # 8N1: start bit, eight bits, stop bit (protocol.md, Line)
LONGEST_RETURN_DELAY_NS = 508_000
"""254 steps of 2 us (e-Manual, Return Delay Time (5)); what a servo may be set to before it was asked."""
TIMEOUT_MARGIN_NS = 10_000_000
"""How long a servo that answered last time is awaited beyond the latest moment of its reply by the wire.

A real servo is never late by more than microseconds, but the host may have to wait for its processor for a
slice or two of the scheduler (3 ms each on a stock Linux), and so may a simulated servo that another program
serves. Ten milliseconds keep that from being taken for a broken cable; only the first silence of a cycle
costs them (the timeouts behind it are short), and they stay below the 15.6 ms after which a loop of 320 Hz
would count as hanging. Servos that the run itself simulates are awaited for longer: `SimulatedPort`.
"""
SHORT_TIMEOUT_MARGIN_NS = 1_000_000
"""The same for a servo that is silent already: it must not take the time of the others."""

MOST_SPARE = 2
"""Two longer forms of a read distinguish late replies from the newest (`exchange/owed.py`)."""


class Line(msgspec.Struct, frozen=True):
    """One serial line as the robot file assumes it; makes transactions with due times and timeouts, ns."""

    baud_rate: int
    latency_ns: int  # Of the adapter, once per request
    return_delay_ns: int
    dialect: Dialect = protocol1
    return_delays: Mapping[int, int] = {}
    """Of servos of which it is known, by ID, ns; `return_delay_ns` is that of all others."""
    device_margin_ns: int = SHORT_TIMEOUT_MARGIN_NS
    """How long a device is awaited beyond the latest moment of its reply by the wire: as briefly as a silent
    servo, so that its loss does not take the servos' time."""

    def wire_ns(self, count: int) -> int:
        """Return the time that `count` bytes take on the wire, ns."""
        return count * BITS_PER_BYTE * 1_000_000_000 // self.baud_rate

    def delay_ns(self, servo_id: int) -> int:
        """Return what a servo waits before it answers, ns."""
        return self.return_delays.get(servo_id, self.return_delay_ns)

    def ping(self, servo_id: int) -> Transaction:
        """Return a ping."""
        length = self.dialect.PING_LENGTH
        return self._answered(self.dialect.ping(servo_id), servo_id, Awaited(servo_id, length, PRESENCE))

    def read(self, servo_id: int, address: int, length: int, spare: int = 0) -> Transaction:
        """Return a read of `length` bytes from `address` on, after which `spare` bytes can be read, too."""
        packet = self.dialect.read(servo_id, address, length)
        read = self._answered(packet, servo_id, Awaited(servo_id, length, address))
        return replace(read, spare=spare) if spare else read

    def read_many(self, requests: Sequence[tuple[int, int, int]], *, fast: bool = False) -> Transaction:
        """Return the read of several servos, each by (ID, address, length); of one alone a plain read.

        `fast`: by a fast form, which all answer by one status. Raises ValueError where a protocol has none.
        """
        if len(requests) == 1:
            return self.read(*requests[0])
        awaited = tuple(Awaited(servo_id, length, address) for servo_id, address, length in requests)
        packet = self.dialect.read_many(requests, fast=fast)
        if not fast:
            return self._answered(packet, BROADCAST_ID, *awaited)
        size = self.dialect.fast_size(sum(one.length for one in awaited), len(awaited))
        # only the first one waits before it speaks: the others add their parts at once (protocol.md, Time)
        due_ns = self.wire_ns(len(packet) + size) + self.delay_ns(awaited[0].servo_id)
        timeout_ns = due_ns + self.latency_ns + TIMEOUT_MARGIN_NS
        return Transaction(packet, BROADCAST_ID, awaited, due_ns, timeout_ns, size, fast=True)

    def write(self, servo_id: int, address: int, data: bytes) -> Transaction:
        """Return a write that the servo acknowledges; to all servos: without reply."""
        packet = self.dialect.write(servo_id, address, data)
        if servo_id == BROADCAST_ID:
            return self.unanswered(packet)
        return self._answered(packet, servo_id, Awaited(servo_id, 0))

    def instruct(self, servo_id: int, packet: bytes) -> Transaction:
        """Return the transaction of an instruction that one servo acknowledges without data."""
        return self._answered(packet, servo_id, Awaited(servo_id, 0))

    def unanswered(self, packet: bytes) -> Transaction:
        """Return a transaction without reply."""
        return Transaction(packet, BROADCAST_ID, (), self.wire_ns(len(packet)), 0)

    def _answered(self, packet: bytes, servo_id: int, *awaited: Awaited) -> Transaction:
        """Return a transaction whose replies come one after the other, each after a return delay."""
        replies = sum(self.dialect.OVERHEAD + one.length for one in awaited)
        due_ns = self.wire_ns(len(packet) + replies) + sum(self.delay_ns(one.servo_id) for one in awaited)
        widest = self.dialect.widest(max(one.length for one in awaited))
        return Transaction(
            packet, servo_id, awaited, due_ns, due_ns + self.latency_ns + TIMEOUT_MARGIN_NS, widest
        )


def lengthen(read: Transaction, more: int, dialect: Dialect, byte_ns: int) -> Transaction:
    """Return the read of one servo with so many of its spare bytes."""
    (awaited,) = read.awaited
    length = awaited.length + more
    return replace(
        read,
        packet=dialect.read(awaited.servo_id, awaited.address, length),
        awaited=(Awaited(awaited.servo_id, length, awaited.address),),
        due_ns=read.due_ns + more * byte_ns,
        timeout_ns=read.timeout_ns + more * byte_ns,
        widest=dialect.widest(length),
    )


def listen(duration_ns: int) -> Transaction:
    """Return a transaction that sends nothing and hears what arrives unasked for `duration_ns`."""
    return Transaction(b"", BROADCAST_ID, (), duration_ns, 0)
