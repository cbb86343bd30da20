"""Traffic counted packet by packet, as the first versions did: the reference for test_traffic.py.

The packets are parsed here anew, so that nothing depends on what the run believed. Sources: ROBOTIS e-Manual,
Protocol 1.0 and Protocol 2.0, instruction and status packets.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache

from dxlrun.channels.packets import LoggedPacket, PacketKind
from dxlrun.log.reader import Log
from dxlrun_analysis.cycles.latency import DISORDER_NS
from dxlrun_analysis.plan import LoggedBus, plan_of

_BYTE_NS = 10_000_000_000
"""Ten bits a byte, over the rate in bit/s."""
BROADCAST_ID = 0xFE

_HEADER_2 = b"\xff\xff\xfd\x00"
_STUFFED, _PLAIN = b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"
_PING, _READ = 0x01, 0x02
_SYNC_READ, _FAST_SYNC_READ, _BULK_READ, _FAST_BULK_READ = 0x82, 0x8A, 0x92, 0x9A

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

ERROR_NUMBERS = {
    1: "result fail",
    2: "instruction",
    3: "CRC",
    4: "range",
    5: "length",
    6: "limit",
    7: "access",
}
"""Bits 0 to 6 of the error byte, a number (ROBOTIS e-Manual, Protocol 2.0, Status Packet)."""

ALERT = 0x80
"""Bit 7 of the error byte of Protocol 2.0: the servo has a hardware error; the reply itself is good."""


@dataclass(frozen=True, slots=True)
class ServoTraffic:
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
    extra_us: float | None = None
    """Median of how much longer than wire and return delay a complete exchange took: what the adapter adds;
    None where the log's plan does not have it, and where replies wait for the next cycle."""
    planned_latency_us: float | None = None
    """What the plan expects of that."""
    port: str = ""


@dataclass(frozen=True, slots=True)
class LoggedRequest:
    """The replies that one instruction requests: from which servos, with how many bytes of data each."""

    servo_ids: tuple[int, ...] = ()
    sizes: tuple[int, ...] = ()
    """Bytes of data a servo; only for reads of several servos."""


@dataclass(frozen=True, slots=True)
class LoggedReply:
    """The answer of one servo; a fast status packet holds several."""

    servo_id: int
    error: int
    """The error byte."""
    protocol: int


@dataclass(slots=True)
class _Count:
    instructions: int = 0
    asked: int = 0
    lost: int = 0
    replies: int = 0
    errors: int = 0
    protocol: int = 1
    error_bytes: set[int] = field(default_factory=set)
    reply_us: Counter[int] = field(default_factory=Counter)
    reply_max_ns: int = 0


@dataclass(slots=True)
class _BusCount:
    """Pairs instructions with replies on one bus: a reply counts until the bus' next instruction."""

    plan: LoggedBus
    counts: defaultdict[int, _Count] = field(default_factory=lambda: defaultdict(_Count))
    packets: Counter[PacketKind] = field(default_factory=Counter)
    bytes: Counter[PacketKind] = field(default_factory=Counter)
    broadcasts: int = 0
    extra_us: Counter[int] = field(default_factory=Counter)
    """How much longer than wire and return delay each complete exchange took."""
    asked: LoggedRequest = field(default_factory=LoggedRequest)
    open: set[int] = field(default_factory=set)
    """Servos that have not answered yet."""
    asked_ns: int = 0
    free_ns: int = 0
    """When the line has carried all that was sent."""
    awaited_ns: int = 0
    """When all that was asked could be there, by the wire and the return delay alone."""
    waiting: list[LoggedPacket] = field(default_factory=list)
    """Packets that may not be in order of time yet."""

    def take(self, packets: Iterable[LoggedPacket]) -> None:
        """Count packets; of the newest ones it is not certain yet that none will come before them."""
        self.waiting += packets
        if not self.waiting:
            return
        newest_ns = self.waiting[-1].first_ns
        if newest_ns - self.waiting[0].first_ns > 2 * DISORDER_NS:
            self.waiting.sort(key=_begin)
            certain = bisect_left(self.waiting, newest_ns - DISORDER_NS, key=_begin)
            self._count(self.waiting[:certain])
            del self.waiting[:certain]

    def finish(self) -> None:
        """Count what is left; what is still open then may have been answered a moment later."""
        self.waiting.sort(key=_begin)
        self._count(self.waiting)
        self.waiting = []
        for servo_id in self.open:
            self.counts[servo_id].asked -= 1
        self.open = set()

    def _count(self, packets: Iterable[LoggedPacket]) -> None:
        for packet in packets:
            size = len(packet.data)
            self.packets[packet.kind] += 1
            self.bytes[packet.kind] += size
            if packet.kind == PacketKind.INSTRUCTION:
                self._instruct(packet)
            elif packet.kind == PacketKind.STATUS:
                self.awaited_ns += self._wire_ns(size) + self.plan.return_delay_ns
                for reply in replies(packet.servo_id, packet.data, self.asked):
                    self._answer(reply, packet.last_ns)

    def _wire_ns(self, size: int) -> int:
        return size * _BYTE_NS // max(self.plan.baud_rate, 1)

    def _instruct(self, packet: LoggedPacket) -> None:
        self._miss()
        if packet.servo_id == BROADCAST_ID:
            self.broadcasts += 1
        else:
            self.counts[packet.servo_id].instructions += 1
        self.asked = request_of(packet.data)
        self.asked_ns = packet.first_ns
        self.awaited_ns = self.free_ns = max(self.free_ns, packet.first_ns) + self._wire_ns(len(packet.data))
        self.open = set(self.asked.servo_ids)
        for servo_id in self.open:
            self.counts[servo_id].asked += 1

    def _answer(self, reply: LoggedReply, at_ns: int) -> None:
        count = self.counts[reply.servo_id]
        count.replies += 1
        count.protocol = reply.protocol
        if reply.error:
            count.errors += 1
            count.error_bytes.add(reply.error)
        if reply.servo_id in self.open:
            self.open.remove(reply.servo_id)
            took_ns = at_ns - self.asked_ns
            count.reply_us[took_ns // 1000] += 1
            count.reply_max_ns = max(count.reply_max_ns, took_ns)
            if not self.open:
                self.extra_us[max(0, at_ns - self.awaited_ns) // 1000] += 1

    def _miss(self) -> None:
        for servo_id in self.open:
            self.counts[servo_id].lost += 1
        self.open = set()


class Traffic:
    """Counts packets, slice by slice of a log, in memory that does not grow with it."""

    __slots__ = ("_lines",)

    def __init__(self) -> None:
        self._lines: dict[str, _BusCount] = {}

    def take(self, log: Log) -> None:
        """Count the packets of the next slice. Raises LogError when one cannot be read."""
        for name in log.buses if not self._lines else ():
            self._lines[name] = _BusCount(plan_of(log).by_name.get(name, LoggedBus(name)))
        by_bus: list[list[LoggedPacket]] = [[] for _ in log.buses]
        for packet in log.packets:
            by_bus[packet.bus].append(packet)
        for line, packets in zip(self._lines.values(), by_bus, strict=True):
            line.take(packets)

    def finish(self) -> tuple[tuple[ServoTraffic, ...], tuple[BusTraffic, ...]]:
        """Return the traffic of each servo and of each bus."""
        for line in self._lines.values():
            line.finish()
        servos = tuple(
            _servo(line.plan, servo_id, count)
            for line in self._lines.values()
            for servo_id, count in sorted(line.counts.items())
        )
        return servos, tuple(_bus(line) for line in self._lines.values())


def _begin(packet: LoggedPacket) -> int:
    return packet.first_ns


def median(counts: Mapping[int, int]) -> float:
    """Return the median of values that are counted; 0 of none."""
    total = sum(counts.values())
    if not total:
        return 0.0
    lower = upper = None
    seen = 0
    for value, number in sorted(counts.items()):
        seen += number
        if lower is None and seen > (total - 1) // 2:
            lower = value
        if seen > total // 2:
            upper = value
            break
    return ((lower or 0) + (upper or 0)) / 2


def _servo(bus: LoggedBus, servo_id: int, count: _Count) -> ServoTraffic:
    joints = {servo.servo_id: servo.own_name for servo in bus.servos}
    joints |= {device.servo_id: device.name for device in bus.devices}
    return ServoTraffic(
        bus=bus.name,
        servo_id=servo_id,
        joint=joints.get(servo_id, ""),
        instructions=count.instructions,
        asked=count.asked,
        lost=count.lost,
        replies=count.replies,
        errors=count.errors,
        error_names=error_names(count.protocol, count.error_bytes),
        reply_median_us=median(count.reply_us),
        reply_max_us=count.reply_max_ns / 1e3,
    )


def _bus(line: _BusCount) -> BusTraffic:
    return BusTraffic(
        name=line.plan.name,
        instructions=line.packets[PacketKind.INSTRUCTION],
        broadcasts=line.broadcasts,
        replies=line.packets[PacketKind.STATUS],
        noise_bytes=line.bytes[PacketKind.NOISE],
        bytes_out=line.bytes[PacketKind.INSTRUCTION],
        bytes_in=line.bytes[PacketKind.STATUS] + line.bytes[PacketKind.NOISE],
        extra_us=median(line.extra_us) if line.plan.baud_rate else None,
        planned_latency_us=line.plan.latency_ns / 1e3 if line.plan.baud_rate else None,
        port=line.plan.port,
    )


def joints_of(log: Log) -> dict[tuple[str, int], str]:
    """Return the joint of each servo, by bus and ID, from the plan in the log."""
    return {(bus.name, servo.servo_id): servo.own_name for bus in plan_of(log).buses for servo in bus.servos}


# Packets, read anew from their bytes


def is_protocol_2(data: bytes) -> bool:
    """Return the protocol by the header; a Protocol 1.0 packet of ID 253 has no length 0."""
    return data.startswith(_HEADER_2)


@lru_cache(maxsize=1024)
def request_of(data: bytes) -> LoggedRequest:
    """Return the servos that answer an instruction at every status return level: pings and reads."""
    second = is_protocol_2(data)
    servo_id, code = (_byte(data, 4), _byte(data, 7)) if second else (_byte(data, 2), _byte(data, 4))
    if code in (_PING, _READ):
        return LoggedRequest() if servo_id == BROADCAST_ID else LoggedRequest((servo_id,))
    if not second:
        return _entries(data[6:-1], 3, 1) if code == _BULK_READ else LoggedRequest()
    body = data[8:-2].replace(_STUFFED, _PLAIN)
    if code in (_SYNC_READ, _FAST_SYNC_READ):
        return LoggedRequest(tuple(body[4:]), (int.from_bytes(body[2:4], "little"),) * len(body[4:]))
    return _entries(body, 5, 0) if code in (_BULK_READ, _FAST_BULK_READ) else LoggedRequest()


def _entries(body: bytes, width: int, at: int) -> LoggedRequest:
    """Return the servos of a bulk read: entries of `width` bytes, the ID at `at`, the size first or last."""
    entries = [body[start : start + width] for start in range(0, len(body) - width + 1, width)]
    sizes = (entry[0] if at else int.from_bytes(entry[3:5], "little") for entry in entries)
    return LoggedRequest(tuple(entry[at] for entry in entries), tuple(sizes))


def replies(servo_id: int, data: bytes, asked: LoggedRequest) -> Iterator[LoggedReply]:
    """Yield the replies in one status packet; `asked` gives the sizes of the blocks of a fast one."""
    if not is_protocol_2(data):
        yield LoggedReply(servo_id, _byte(data, 4), 1)
    elif servo_id != BROADCAST_ID:
        yield LoggedReply(servo_id, _byte(data, 8), 2)
    else:
        at = 8
        for size in asked.sizes:  # a block: error, ID, data, CRC
            if at + size + 4 <= len(data):
                yield LoggedReply(data[at + 1], data[at], 2)
            at += size + 4


def error_names(protocol: int, errors: set[int]) -> tuple[str, ...]:
    """Return the names of all errors in these error bytes."""
    if protocol == 1:
        return tuple(name for bit, name in ERROR_BITS.items() if any(error & bit for error in errors))
    numbers = {error & ~ALERT for error in errors}
    names = tuple(name for number, name in ERROR_NUMBERS.items() if number in numbers)
    return (*names, "alert") if any(error & ALERT for error in errors) else names


def _byte(data: bytes, index: int) -> int:
    return data[index] if index < len(data) else 0
