"""Line: the times of one serial line, and the transactions that are made of them."""

from __future__ import annotations

from dataclasses import dataclass

from dxlrun.dynamixel import protocol1
from dxlrun.dynamixel.transaction import BROADCAST_ID, Transaction

BITS_PER_BYTE = 10
"""8N1: start bit, eight bits, stop bit (protocol.md, Line)."""
LONGEST_RETURN_DELAY_NS = 508_000
"""254 steps of 2 us (e-Manual, Return Delay Time (5)); what a servo may be set to before it was asked."""
PATIENCE_NS = 10_000_000
"""How long a servo that answered last time is awaited beyond the latest moment of its reply by the wire.

A real servo is never late by more than microseconds, but a simulated one is a process of the same machine: it
may have to wait for its processor for a slice or two of the scheduler (3 ms each on a stock kernel). Ten
milliseconds keep that from being taken for a broken cable; only the first silence of a cycle costs them
(`hardware` is short with everybody after it), and they stay below the 15.6 ms after which a loop of 320 Hz
would count as hanging.
"""
SHORT_PATIENCE_NS = 1_000_000
"""The same for a servo that is silent already: it must not take the time of the others."""


@dataclass(frozen=True, slots=True)
class Line:
    """One serial line as the robot file assumes it; makes transactions with due times and timeouts, ns."""

    baud_rate: int
    latency_ns: int
    """Of the adapter, once per request."""
    return_delay_ns: int

    def wire_ns(self, count: int) -> int:
        """Return the time that `count` bytes take on the wire, ns."""
        return count * BITS_PER_BYTE * 1_000_000_000 // self.baud_rate

    def ping(self, servo_id: int) -> Transaction:
        """Return a ping."""
        return self._with_reply(protocol1.ping(servo_id), servo_id, 0)

    def read(self, servo_id: int, address: int, length: int) -> Transaction:
        """Return a read of `length` bytes from `address` on."""
        return self._with_reply(protocol1.read(servo_id, address, length), servo_id, length)

    def write(self, servo_id: int, address: int, data: bytes) -> Transaction:
        """Return a write that the servo acknowledges; to everybody: without reply."""
        packet = protocol1.write(servo_id, address, data)
        if servo_id == BROADCAST_ID:
            return self.unanswered(packet)
        return self._with_reply(packet, servo_id, 0)

    def unanswered(self, packet: bytes) -> Transaction:
        """Return a transaction without reply."""
        return Transaction(packet, BROADCAST_ID, -1, self.wire_ns(len(packet)), 0)

    def _with_reply(self, packet: bytes, servo_id: int, reply_length: int) -> Transaction:
        wire_ns = self.wire_ns(len(packet) + protocol1.OVERHEAD + reply_length)
        due_ns = wire_ns + self.return_delay_ns
        return Transaction(packet, servo_id, reply_length, due_ns, due_ns + self.latency_ns + PATIENCE_NS)


def listen(duration_ns: int) -> Transaction:
    """Return a transaction that sends nothing and hears what arrives unasked for `duration_ns`."""
    return Transaction(b"", BROADCAST_ID, -1, duration_ns, 0)
