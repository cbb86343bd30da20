"""Line: builds transactions for one serial line, with due times and timeouts that follow from its speed
and delays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
from msgspec.structs import replace

from dxlwire.transaction import BROADCAST_ID, PRESENCE, ExpectedReply, Transaction
from dxlwire.wire import protocol1
from dxlwire.wire.dialect import Dialect

BITS_PER_BYTE = 10  # 8N1: start bit, eight bits, stop bit (protocol.md, Line)
LONGEST_RETURN_DELAY_NS = 508_000
"""Return delay that is assumed until a servo reports its setting, ns: 254 steps of 2 us (e-Manual, Return
Delay Time (5))."""
TIMEOUT_MARGIN_NS = 10_000_000
"""Time (ns) that the host waits for a servo with a recent reply, after the latest arrival that the wire
allows.

A real servo is late by microseconds at most. But the host may have to wait for its processor for a slice
or two of the scheduler (3 ms each on a stock Linux). The same holds for a simulated servo in another
process. Ten milliseconds keep this stall from being reported as a broken cable. Only the first timeout of
a cycle takes that long (the later ones are short). It stays below the 15.6 ms after which a loop of 320 Hz
would count as hanging. Servos that the run itself simulates have a longer timeout: `SimulatedPort`."""
SHORT_TIMEOUT_MARGIN_NS = 1_000_000
"""Time (ns) like TIMEOUT_MARGIN_NS for a servo that is already silent: it must not use up the time of the
other servos."""

MOST_SPARE = 2
"""Largest number of extra bytes in a read; the different lengths distinguish late replies from the newest
one (`exchange/owed.py`)."""


class Line(msgspec.Struct, frozen=True):
    """Timing of one serial line according to the robot file; its methods build transactions with due times
    and timeouts, ns, and send nothing."""

    baud_rate: int
    latency_ns: int  # Latency of the adapter, once per request
    return_delay_ns: int
    dialect: Dialect = protocol1
    return_delays: Mapping[int, int] = {}
    """Known return delays by servo ID, ns; all other servos have `return_delay_ns`."""
    device_margin_ns: int = SHORT_TIMEOUT_MARGIN_NS
    """Time (ns) that the host waits for a device after the latest arrival that the wire allows. It is as
    short as for a silent servo, so that a lost device does not use up the time of the servos."""

    def wire_ns(self, count: int) -> int:
        """Return the time that `count` bytes take on the wire, ns."""
        return count * BITS_PER_BYTE * 1_000_000_000 // self.baud_rate

    def delay_ns(self, servo_id: int) -> int:
        """Return the time that a servo waits before it answers, ns."""
        return self.return_delays.get(servo_id, self.return_delay_ns)

    def ping(self, servo_id: int) -> Transaction:
        """Return a transaction that pings one servo."""
        length = self.dialect.PING_LENGTH
        return self._answered(
            self.dialect.ping(servo_id), servo_id, ExpectedReply(servo_id, length, PRESENCE)
        )

    def read_range(self, servo_id: int, address: int, length: int, spare: int = 0) -> Transaction:
        """Return a transaction that reads `length` bytes from `address`, after which `spare` more bytes
        are readable."""
        packet = self.dialect.read_range(servo_id, address, length)
        read = self._answered(packet, servo_id, ExpectedReply(servo_id, length, address))
        return replace(read, spare=spare) if spare else read

    def read_many(self, requests: Sequence[tuple[int, int, int]], *, fast: bool = False) -> Transaction:
        """Return a transaction that reads several servos at once, or a plain read of a single servo.

        Args:
            requests: ID, address and length for each servo.
            fast: Use a fast form: all servos share one status packet.

        Raises:
            ValueError: The protocol has no fast form.
        """
        if len(requests) == 1:
            return self.read_range(*requests[0])
        awaited = tuple(ExpectedReply(servo_id, length, address) for servo_id, address, length in requests)
        packet = self.dialect.read_many(requests, fast=fast)
        if not fast:
            return self._answered(packet, BROADCAST_ID, *awaited)
        size = self.dialect.fast_size(sum(one.length for one in awaited), len(awaited))
        # Only the first servo has a return delay: the others append their entries at once (protocol.md,
        # Time).
        due_ns = self.wire_ns(len(packet) + size) + self.delay_ns(awaited[0].servo_id)
        timeout_ns = due_ns + self.latency_ns + TIMEOUT_MARGIN_NS
        return Transaction(packet, BROADCAST_ID, awaited, due_ns, timeout_ns, size, fast=True)

    def write_range(self, servo_id: int, address: int, data: bytes) -> Transaction:
        """Return a transaction that writes data and awaits the acknowledgement; a write to the broadcast
        ID has none."""
        packet = self.dialect.write_range(servo_id, address, data)
        if servo_id == BROADCAST_ID:
            return self.unanswered(packet)
        return self._answered(packet, servo_id, ExpectedReply(servo_id, 0))

    def instruct(self, servo_id: int, packet: bytes) -> Transaction:
        """Return a transaction that sends an instruction packet to one servo, which acknowledges it
        without data."""
        return self._answered(packet, servo_id, ExpectedReply(servo_id, 0))

    def unanswered(self, packet: bytes) -> Transaction:
        """Return a transaction that sends a packet to which no servo replies."""
        return Transaction(packet, BROADCAST_ID, (), self.wire_ns(len(packet)), 0)

    def _answered(self, packet: bytes, servo_id: int, *awaited: ExpectedReply) -> Transaction:
        """Return a transaction whose replies follow one another, each after the return delay of its servo."""
        replies = sum(self.dialect.OVERHEAD + one.length for one in awaited)
        due_ns = self.wire_ns(len(packet) + replies) + sum(self.delay_ns(one.servo_id) for one in awaited)
        widest = self.dialect.widest(max(one.length for one in awaited))
        return Transaction(
            packet, servo_id, awaited, due_ns, due_ns + self.latency_ns + TIMEOUT_MARGIN_NS, widest
        )


def lengthen(read: Transaction, more: int, dialect: Dialect, byte_ns: int) -> Transaction:
    """Return the read of one servo with `more` additional bytes, so that its reply has another length."""
    (awaited,) = read.awaited
    length = awaited.length + more
    return replace(
        read,
        packet=dialect.read_range(awaited.servo_id, awaited.address, length),
        awaited=(ExpectedReply(awaited.servo_id, length, awaited.address),),
        due_ns=read.due_ns + more * byte_ns,
        timeout_ns=read.timeout_ns + more * byte_ns,
        widest=dialect.widest(length),
    )


def listen_transaction(duration_ns: int) -> Transaction:
    """Return a transaction that sends nothing for `duration_ns`, while bytes from the line are received
    and logged."""
    return Transaction(b"", BROADCAST_ID, (), duration_ns, 0)
