"""A prepared exchange on a bus: the bytes that go out, and what is awaited."""

from __future__ import annotations

from dataclasses import dataclass

BROADCAST_ID = 0xFE


@dataclass(frozen=True, slots=True)
class Transaction:
    """One instruction packet and the shape of its reply."""

    packet: bytes
    servo_id: int
    """Who answers; `BROADCAST_ID`: nobody does."""
    reply_length: int
    """Number of parameter bytes of the awaited status packet; -1: none is awaited."""
    due_ns: int
    """From the start of the write to the last byte of the reply, by the wire; without reply: the wire time."""
    timeout_ns: int
    """From the start of the write to giving up; 0 without reply."""
