"""Traffic counted packet by packet over a whole log: the reference for test_traffic.py.

The packets are parsed here anew, so that nothing depends on what the run believed. Sources: ROBOTIS e-Manual,
Protocol 1.0 and Protocol 2.0, instruction and status packets.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from statistics import median
from typing import Any, NamedTuple

from dxlrun.channels.logged_packets import LoggedPacket
from dxlrun_analysis.plan_excerpt import LoggedBus, plan_of
from dxlrun_analysis.servos.traffic import error_names
from dxlwire.packets import PacketKind

BYTE_NS = 10_000_000_000  # Ten bits a byte, over the rate in bit/s
BROADCAST_ID = 0xFE
HEADER_2 = b"\xff\xff\xfd\x00"
PING, READ = 0x01, 0x02
SYNC_READ, FAST_SYNC_READ, BULK_READ, FAST_BULK_READ = 0x82, 0x8A, 0x92, 0x9A

Row = dict[str, object]
Asked = dict[int, int]  # The servos that an instruction asks, each with its bytes of data; 0: not known


class Reply(NamedTuple):
    """The answer of one servo; a fast status packet holds several."""

    servo_id: int
    error: int
    protocol: int


@dataclass
class Servo:
    instructions: int = 0
    asked: int = 0
    lost: int = 0
    replies: int = 0
    errors: int = 0
    protocol: int = 1
    error_bytes: set[int] = field(default_factory=set)
    took_ns: list[int] = field(default_factory=list)


@dataclass
class Line:
    """Pairs instructions with replies on one bus: a reply counts until the bus' next instruction."""

    plan: LoggedBus
    servos: defaultdict[int, Servo] = field(default_factory=lambda: defaultdict(Servo))
    packets: Counter[PacketKind] = field(default_factory=Counter)
    bytes: Counter[PacketKind] = field(default_factory=Counter)
    broadcasts: int = 0
    extra_us: list[int] = field(default_factory=list)
    """How much longer than wire and return delay each complete exchange took."""
    sizes: list[tuple[int, int]] = field(default_factory=list)
    open: set[int] = field(default_factory=set)  # Servos that have not answered yet
    asked_ns: int = 0
    free_ns: int = 0  # When the line has carried all that was sent
    awaited_ns: int = 0  # When all that was asked could be there, by the wire and the return delay alone

    def take(self, packet: LoggedPacket) -> None:
        wire_ns = len(packet.data) * BYTE_NS // max(self.plan.baud_rate, 1)
        self.packets[packet.kind] += 1
        self.bytes[packet.kind] += len(packet.data)
        if packet.kind == PacketKind.INSTRUCTION:
            for servo_id in self.open:
                self.servos[servo_id].lost += 1
            self.instruct(packet, wire_ns)
        elif packet.kind == PacketKind.STATUS:
            self.awaited_ns += wire_ns + self.plan.return_delay_ns
            for reply in replies(packet, self.sizes):
                self.answer(reply, packet.last_ns)
        elif packet.kind == PacketKind.LATE:  # a reply that its request no longer waited for
            self.servos[packet.servo_id].replies += 1

    def instruct(self, packet: LoggedPacket, wire_ns: int) -> None:
        if packet.servo_id == BROADCAST_ID:
            self.broadcasts += 1
        else:
            self.servos[packet.servo_id].instructions += 1
        self.sizes = list(asked(packet.data))
        self.asked_ns = packet.first_ns
        self.awaited_ns = self.free_ns = max(self.free_ns, packet.first_ns) + wire_ns
        self.open = {servo_id for servo_id, _ in self.sizes}
        for servo_id in self.open:
            self.servos[servo_id].asked += 1

    def answer(self, reply: Reply, at_ns: int) -> None:
        servo = self.servos[reply.servo_id]
        servo.replies += 1
        servo.protocol = reply.protocol
        if reply.error:
            servo.errors += 1
            servo.error_bytes.add(reply.error)
        if reply.servo_id in self.open:
            self.open.remove(reply.servo_id)
            servo.took_ns.append(at_ns - self.asked_ns)
            if not self.open:
                self.extra_us.append(max(0, at_ns - self.awaited_ns) // 1000)

    def rows(self) -> Iterator[Row]:
        for servo_id, servo in sorted(self.servos.items()):
            yield {
                "bus": self.plan.name,
                "servo_id": servo_id,
                "joint": self.plan.names.get(servo_id, ""),
                "instructions": servo.instructions,
                # what is open where the log ends may have been answered a moment later
                "asked": servo.asked - (servo_id in self.open),
                "lost": servo.lost,
                "replies": servo.replies,
                "errors": servo.errors,
                "error_names": error_names(servo.protocol, servo.error_bytes),
                "reply_median_us": median([ns // 1000 for ns in servo.took_ns] or [0]),
                "reply_max_us": max(servo.took_ns, default=0) / 1e3,
            }

    def row(self) -> Row:
        known = bool(self.plan.baud_rate)
        return {
            "name": self.plan.name,
            "instructions": self.packets[PacketKind.INSTRUCTION],
            "broadcasts": self.broadcasts,
            "replies": self.packets[PacketKind.STATUS],
            "noise_bytes": self.bytes[PacketKind.NOISE],
            "bytes_out": self.bytes[PacketKind.INSTRUCTION],
            "bytes_in": self.bytes[PacketKind.STATUS] + self.bytes[PacketKind.NOISE],
            "extra_us": median(self.extra_us or [0]) if known else None,
            "planned_latency_us": self.plan.latency_ns / 1e3 if known else None,
            "port": self.plan.port,
        }


def traffic(log: Any) -> tuple[list[Row], list[Row]]:
    """Return the traffic of each servo, and of each bus."""
    lines = []
    for index, name in enumerate(log.buses):
        line = Line(plan_of(log).by_name.get(name, LoggedBus(name)))
        for packet in sorted((p for p in log.packets if p.bus == index), key=lambda packet: packet.first_ns):
            line.take(packet)
        lines.append(line)
    return [row for line in lines for row in line.rows()], [line.row() for line in lines]


# Packets, read anew from their bytes


def asked(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield the servos that answer an instruction at every status return level, with their bytes of data."""
    second = data.startswith(HEADER_2)
    servo_id, code = (byte(data, 4), byte(data, 7)) if second else (byte(data, 2), byte(data, 4))
    body = data[8:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd") if second else data[6:-1]
    if code in (PING, READ):
        if servo_id != BROADCAST_ID:
            yield servo_id, 0
    elif second and code in (SYNC_READ, FAST_SYNC_READ):
        for each in body[4:]:
            yield each, int.from_bytes(body[2:4], "little")
    elif second and code in (BULK_READ, FAST_BULK_READ):
        for at in range(0, len(body) - 4, 5):
            yield body[at], int.from_bytes(body[at + 3 : at + 5], "little")
    elif not second and code == BULK_READ:
        for at in range(0, len(body) - 2, 3):
            yield body[at + 1], body[at]


def replies(packet: LoggedPacket, sizes: list[tuple[int, int]]) -> Iterator[Reply]:
    """Yield the replies in one status packet; `sizes` are those of the blocks of a fast one."""
    data = packet.data
    if not data.startswith(HEADER_2):
        yield Reply(packet.servo_id, byte(data, 4), 1)
    elif packet.servo_id != BROADCAST_ID:
        yield Reply(packet.servo_id, byte(data, 8), 2)
    else:
        at = 8
        for _, size in sizes:  # a block: error, ID, data, CRC
            if size and at + size + 4 <= len(data):
                yield Reply(data[at + 1], data[at], 2)
            at += size + 4


def byte(data: bytes, index: int) -> int:
    return data[index] if index < len(data) else 0
