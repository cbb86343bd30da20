"""What happened on the wires: who was asked, who answered, how soon, with which error bits."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import msgspec
import numpy as np

from dxlrun.packets import LoggedPacket, PacketKind
from dxlrun.recording.reader import Log

_BROADCAST_ID = 0xFE
_PING, _READ = 0x01, 0x02
_SERVO_CODE = 4
"""Index of the instruction, or of the error byte, in a Protocol 1.0 packet: FF FF ID LEN it."""

ERROR_BITS = {
    0x01: "voltage",
    0x02: "angle limit",
    0x04: "overheating",
    0x08: "range",
    0x10: "checksum",
    0x20: "overload",
    0x40: "instruction",
}
"""Bits of the error byte (ROBOTIS e-Manual, Protocol 1.0, Status Packet)."""


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
    """Pings and reads: those it has to answer at every status return level."""
    lost: int
    """Of `asked`, without a status packet of this servo before the bus' next instruction."""
    replies: int
    """Status packets, acknowledged writes included."""
    errors: int
    """Replies with any error bit."""
    error_names: tuple[str, ...]
    reply_median_us: float
    """From before the write() of a ping or read to after the read() of the reply's last byte."""
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
    bits: int = 0
    reply_ns: list[int] = field(default_factory=list)


def traffic(log: Log) -> tuple[tuple[Servo, ...], tuple[BusTraffic, ...]]:
    """Return the traffic per servo and per bus. Raises LogError when a packet cannot be read."""
    joints = _joints(log)
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
    """Pair instructions with replies; `packets` of one bus, in order of time."""
    counts: dict[int, _Count] = {}
    asked: LoggedPacket | None = None
    for packet in packets:
        if packet.kind == PacketKind.INSTRUCTION:
            _miss(asked, counts)
            asked = None
        if packet.kind == PacketKind.NOISE or packet.servo_id == _BROADCAST_ID:
            continue
        count = counts.setdefault(packet.servo_id, _Count())
        code = packet.data[_SERVO_CODE] if len(packet.data) > _SERVO_CODE else 0
        if packet.kind == PacketKind.INSTRUCTION:
            count.instructions += 1
            if code in (_PING, _READ):
                count.asked += 1
                asked = packet
            continue
        count.replies += 1
        count.errors += code != 0
        count.bits |= code
        if asked is not None and asked.servo_id == packet.servo_id:
            count.reply_ns.append(packet.last_ns - asked.first_ns)
            asked = None
    _miss(asked, counts)
    return counts


def _miss(asked: LoggedPacket | None, counts: dict[int, _Count]) -> None:
    if asked is not None:
        counts[asked.servo_id].lost += 1


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
        error_names=tuple(name for bit, name in ERROR_BITS.items() if count.bits & bit),
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
        broadcasts += packet.kind == PacketKind.INSTRUCTION and packet.servo_id == _BROADCAST_ID
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


def _joints(log: Log) -> dict[tuple[str, int], str]:
    """Return the joint of each servo, by bus and ID, from the plan in the log."""
    try:
        plan = msgspec.json.decode(log.attachments.get("plan.json", b"{}"), type=_Planned)
    except msgspec.MsgspecError:
        return {}  # a log without a readable plan still has packets
    return {(bus.name, servo.servo_id): servo.joint for bus in plan.buses for servo in bus.servos}
