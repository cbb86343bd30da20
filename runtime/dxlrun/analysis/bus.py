"""What happened on the wires: who was asked, who answered, how soon, with which error bits."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import msgspec
import numpy as np

from dxlrun.analysis.wire import BROADCAST_ID, Question, Reply, error_names, question, replies
from dxlrun.packets import LoggedPacket, PacketKind
from dxlrun.recording.reader import Log


@dataclass(frozen=True, slots=True)
class Servo:
    """One servo's traffic over the whole log, set-up and shutdown included."""

    bus: str
    servo_id: int
    joint: str
    """Empty where the log's plan names none."""
    instructions: int
    """Addressed to it alone."""
    asked: int
    """Pings and reads, also those of several servos at once: what it has to answer at every status return
    level."""
    lost: int
    """Of `asked`, without a status packet of this servo before the bus' next instruction. What is still open
    where the log ends is in neither: its reply may have come a moment later."""
    replies: int
    """Status packets, acknowledged writes included."""
    errors: int
    """Replies with any error bit."""
    error_names: tuple[str, ...]
    reply_median_us: float
    """From before the write() of a ping or read to after the read() of the reply's last byte; in a read of
    several servos at once, those that answer later have the replies before theirs in it."""
    reply_max_us: float


@dataclass(frozen=True, slots=True)
class BusTraffic:
    """One bus over the whole log."""

    name: str
    instructions: int
    broadcasts: int
    replies: int
    noise_bytes: int
    """Bytes that belong to no intact packet."""
    bytes_out: int
    bytes_in: int


@dataclass(slots=True)
class _Count:
    instructions: int = 0
    asked: int = 0
    lost: int = 0
    replies: int = 0
    errors: int = 0
    protocol: int = 1
    error_bytes: set[int] = field(default_factory=set)
    reply_ns: list[int] = field(default_factory=list)


@dataclass(slots=True)
class _Pairing:
    """Pairs instructions with replies on one bus: a reply counts until the bus' next instruction."""

    counts: dict[int, _Count] = field(default_factory=dict)
    asked: Question = field(default_factory=Question)
    open: set[int] = field(default_factory=set)
    """Servos that have not answered yet."""
    asked_ns: int = 0

    def count(self, servo_id: int) -> _Count:
        return self.counts.setdefault(servo_id, _Count())

    def instruct(self, packet: LoggedPacket) -> None:
        self.miss()
        if packet.servo_id != BROADCAST_ID:
            self.count(packet.servo_id).instructions += 1
        self.asked = question(packet.data)
        self.asked_ns = packet.first_ns
        self.open = set(self.asked.servo_ids)
        for servo_id in self.open:
            self.count(servo_id).asked += 1

    def answer(self, reply: Reply, at_ns: int) -> None:
        count = self.count(reply.servo_id)
        count.replies += 1
        count.protocol = reply.protocol
        if reply.error:
            count.errors += 1
            count.error_bytes.add(reply.error)
        if reply.servo_id in self.open:
            self.open.remove(reply.servo_id)
            count.reply_ns.append(at_ns - self.asked_ns)

    def miss(self) -> None:
        for servo_id in self.open:
            self.counts[servo_id].lost += 1
        self.open = set()

    def end(self) -> None:
        for servo_id in self.open:
            self.counts[servo_id].asked -= 1
        self.open = set()


def traffic(log: Log) -> tuple[tuple[Servo, ...], tuple[BusTraffic, ...]]:
    """Return the traffic per servo and per bus. Raises LogError when a packet cannot be read."""
    joints = joints_of(log)
    servos: list[Servo] = []
    buses: list[BusTraffic] = []
    for index, name in enumerate(log.buses):
        packets = sorted((p for p in log.packets if p.bus == index), key=lambda packet: packet.first_ns)
        counts = _count(packets)
        for servo_id, count in sorted(counts.items()):
            servos.append(_servo(name, servo_id, joints.get((name, servo_id), ""), count))
        buses.append(_bus(name, packets))
    return tuple(servos), tuple(buses)


def _count(packets: Iterable[LoggedPacket]) -> dict[int, _Count]:
    """Count what each servo was asked and answered; `packets` of one bus, in order of time."""
    pairing = _Pairing()
    for packet in packets:
        if packet.kind == PacketKind.INSTRUCTION:
            pairing.instruct(packet)
        elif packet.kind == PacketKind.STATUS:
            for reply in replies(packet.servo_id, packet.data, pairing.asked):
                pairing.answer(reply, packet.last_ns)
    pairing.end()
    return pairing.counts


def _servo(bus: str, servo_id: int, joint: str, count: _Count) -> Servo:
    times = np.array(count.reply_ns or [0]) / 1e3
    return Servo(
        bus=bus,
        servo_id=servo_id,
        joint=joint,
        instructions=count.instructions,
        asked=count.asked,
        lost=count.lost,
        replies=count.replies,
        errors=count.errors,
        error_names=error_names(count.protocol, count.error_bytes),
        reply_median_us=float(np.median(times)),
        reply_max_us=float(times.max()),
    )


def _bus(name: str, packets: Iterable[LoggedPacket]) -> BusTraffic:
    number = dict.fromkeys(PacketKind, 0)
    size = dict.fromkeys(PacketKind, 0)
    broadcasts = 0
    for packet in packets:
        number[packet.kind] += 1
        size[packet.kind] += len(packet.data)
        broadcasts += packet.kind == PacketKind.INSTRUCTION and packet.servo_id == BROADCAST_ID
    return BusTraffic(
        name=name,
        instructions=number[PacketKind.INSTRUCTION],
        broadcasts=broadcasts,
        replies=number[PacketKind.STATUS],
        noise_bytes=size[PacketKind.NOISE],
        bytes_out=size[PacketKind.INSTRUCTION],
        bytes_in=size[PacketKind.STATUS] + size[PacketKind.NOISE],
    )


class _PlannedServo(msgspec.Struct):
    joint: str
    servo_id: int


class _PlannedBus(msgspec.Struct):
    name: str
    servos: list[_PlannedServo] = []


class _Planned(msgspec.Struct):
    buses: list[_PlannedBus] = []


def joints_of(log: Log) -> dict[tuple[str, int], str]:
    """Return the joint of each servo, by bus and ID, from the plan in the log."""
    try:
        plan = msgspec.json.decode(log.attachments.get("plan.json", b"{}"), type=_Planned)
    except (msgspec.MsgspecError, ValueError):
        return {}  # a log without a readable plan still has packets
    return {(bus.name, servo.servo_id): servo.joint for bus in plan.buses for servo in bus.servos}
