"""What the two protocols have in common for a servo: an instruction packet, a reply, group reads."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import msgspec

BROADCAST = 0xFE


class InstructionPacket(NamedTuple):
    """One packet on the line."""

    servo_id: int
    instruction: int
    parameters: bytes
    intact: bool  # False when the checksum is wrong: then nothing else of it can be trusted
    end: int  # Index behind its last byte, in the bytes that completed it
    raw: bytes = b""  # All of its bytes, as they were on the line


class ServoReply(NamedTuple):
    """What a servo sends back, and how long after the instruction's last byte it starts to."""

    servo_id: int
    error: int
    parameters: bytes
    delay_ns: int


class ReadEntry(NamedTuple):
    """What is read of one servo of a list."""

    servo_id: int
    address: int
    length: int


class GroupRead(msgspec.Struct, frozen=True):
    """An instruction that several servos answer one after the other, in the order of its list."""

    instruction: int
    entries: tuple[ReadEntry, ...]
    fast: bool = False  # True: the servos share one status packet
    has_slots: bool = False
    """True: a servo may wait for the time of an absent one before it [?]; False: it waits for its reply."""

    @property
    def lengths(self) -> tuple[int, ...]:
        """Number of bytes of each entry."""
        return tuple(each.length for each in self.entries)


class Receiver(Protocol):
    """Finds instruction packets in the bytes of a line."""

    @property
    def pending(self) -> int:
        """Number of bytes of a packet that is not complete."""

    def forget(self) -> None:
        """Drop a packet that was not completed in time."""

    def feed(self, data: bytes | bytearray, start: int = 0) -> InstructionPacket | None:
        """Take bytes from `start` on until a packet is complete, and return it; None: all were taken."""


class FastStatus(Protocol):
    """A status packet that several servos put together."""

    def part(self, reply: ServoReply) -> bytes:
        """Return the bytes that the next servo adds."""


class Codec(Protocol):
    """A protocol's bytes: the modules `protocol1` and `protocol2`."""

    LONGEST_PAUSE_NS: int
    HEADER: bytes
    ID_AT: int  # Place of the ID in a packet

    def receiver(self) -> Receiver:
        """Return a receiver for one line."""

    def status_packet(self, servo_id: int, error: int, parameters: bytes = b"") -> bytes:
        """Return the bytes of a status packet."""

    def group_read(self, packet: InstructionPacket) -> GroupRead | None:
        """Return the group read that a packet is; None: it is none, or its parameters are wrong."""

    def fast_status(self, lengths: tuple[int, ...]) -> FastStatus:
        """Return an empty status packet for so many bytes of so many servos."""
