"""Packets on the wire of a simulated bus, read from its ledger without code of the runtime.

Addresses and units are those of FACTS, from the e-Manual.
"""

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Literal, NamedTuple

from tests.kit.packets import crc

from dxlrun.plan.robot_plan import Plan
from dxlsim.bus.ledger import LedgerEntry
from dxlwire.bus_plan import BusPlan, ServoPlan

PING, READ, WRITE, REBOOT = 0x01, 0x02, 0x03, 0x08
SYNC_WRITE, SYNC_READ, FAST_SYNC_READ, BULK_READ = 0x83, 0x82, 0x8A, 0x92
HOST_SAYS = frozenset((PING, READ, WRITE, REBOOT, SYNC_WRITE, SYNC_READ, FAST_SYNC_READ, BULK_READ))
BROADCAST, STATUS = 254, 0x55
HEADER = b"\xff\xff\xfd\x00"
Item = Literal["torque_enable", "goal_position", "present_position", "goal_current", "operating_mode"]


class Facts(NamedTuple):
    """What the e-Manual has about a model: the angle of a tick, and address and size of each item."""

    rad_per_tick: float
    items: Mapping[Item, tuple[int, int]]


X430: Mapping[Item, tuple[int, int]] = {
    "torque_enable": (64, 1),
    "goal_position": (116, 4),
    "present_position": (132, 4),
    "goal_current": (102, 2),
    "operating_mode": (11, 1),
}
FACTS: Mapping[str, Facts] = {
    "AX-12A": Facts(
        math.radians(300) / 1023,
        {"torque_enable": (24, 1), "goal_position": (30, 2), "present_position": (36, 2)},
    ),
    "XM430-W350": Facts(math.tau / 4096, X430),
}


def angle(servo: ServoPlan, raw: int) -> float:
    """Return the joint's angle, rad, of a position in ticks: direction * (theta - reference)."""
    return servo.direction * (raw * FACTS[servo.model].rad_per_tick - servo.reference)


def value_at(servo: ServoPlan, item: Item, address: int, data: bytes) -> int | None:
    """Return an item's value in bytes from an address on; None: they do not have it."""
    place, size = FACTS[servo.model].items.get(item, (-1, 0))
    at = place - address
    if size == 0 or not 0 <= at <= len(data) - size:
        return None
    return int.from_bytes(data[at : at + size], "little", signed=size == 4)


def stands_at(servo: ServoPlan, state: bytes) -> float:
    """Return the joint's angle, rad, in a block of state that begins where the plan reads it."""
    raw = value_at(servo, "present_position", servo.state.address, state)
    assert raw is not None
    return angle(servo, raw)


class Instruction(NamedTuple):
    t_ns: int
    servo_id: int
    instruction: int
    parameters: bytes


class StateReply(NamedTuple):
    """A state that a servo sent, and when the host asked for it where that is known."""

    t_ns: int
    servo_id: int
    data: bytes
    asked_ns: int = 0


def data_of(reply: bytes, protocol: float) -> bytes:
    """Return the data in what a servo sends: a status, or its part of the one of a fast form."""
    if protocol == 1.0:
        return reply[5:-1]
    if not reply.startswith(HEADER):
        return reply[2:-2]
    return reply[10:-2] if reply[4] == BROADCAST else reply[9:-2]


def instructions(entries: Sequence[LedgerEntry], bus: BusPlan) -> Iterator[Instruction]:
    """Take apart all that the host sent; whatever is no legal instruction fails."""
    known = {servo.servo_id for servo in bus.servos}
    for sent in taken_apart(entries, bus.protocol):
        assert sent.instruction in HOST_SAYS, sent
        assert sent.servo_id in known | {BROADCAST}, sent
        yield sent


def taken_apart(entries: Iterable[LedgerEntry], protocol: float) -> Iterator[Instruction]:
    """Yield each packet of the host."""
    for entry in entries:
        data = entry.data if entry.direction == "in" else b""
        while data:
            end = packet_end(data, protocol)
            assert end, data.hex(" ")
            yield Instruction(entry.t_ns, *opened(data[:end], protocol))
            data = data[end:]


def packet_end(data: bytes, protocol: float) -> int:
    """Return the size of the whole packet with which bytes begin; 0: there is none, or it is damaged."""
    if protocol == 1.0:
        end = 4 + data[3] if len(data) > 5 and data[:2] == b"\xff\xff" else 0
        return end if 5 < end <= len(data) and sum(data[2:end]) & 0xFF == 0xFF else 0
    end = 7 + int.from_bytes(data[5:7], "little") if data.startswith(HEADER) else 0
    if not 9 < end <= len(data) or crc(data[: end - 2]) != int.from_bytes(data[end - 2 : end], "little"):
        return 0
    return end


def opened(packet: bytes, protocol: float) -> tuple[int, int, bytes]:
    """Return ID, instruction (or error of Protocol 1.0) and parameters of a packet."""
    if protocol == 1.0:
        return packet[2], packet[4], packet[5:-1]
    return packet[4], packet[7], packet[8:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")


def commands(sent: Collection[Instruction], protocol: float) -> set[tuple[int, int, bytes]]:
    """Return servo, address and bytes of all that was written, each once; a reboot writes nothing at 0."""
    found = {one for each in sent for one in writes(each, protocol)}
    return found | {(one.servo_id, 0, b"") for one in sent if one.instruction == REBOOT}


def writes(sent: Instruction, protocol: float) -> Iterator[tuple[int, int, bytes]]:
    """Return servo, address and bytes of all that an instruction writes."""
    width = 1 if protocol == 1.0 else 2
    parameters = sent.parameters
    address = int.from_bytes(parameters[:width], "little")
    if sent.instruction == WRITE:
        yield sent.servo_id, address, parameters[width:]
    elif sent.instruction == SYNC_WRITE:
        size = int.from_bytes(parameters[width : 2 * width], "little")
        blocks = parameters[2 * width :]
        assert len(blocks) % (size + 1) == 0
        for at in range(0, len(blocks), size + 1):
            yield blocks[at], address, blocks[at + 1 : at + 1 + size]


def all_writes(entries: Sequence[LedgerEntry], bus: BusPlan) -> Iterator[tuple[int, int, int, bytes]]:
    """Return time, servo, address and bytes of all that was written; to each servo what is for all."""
    for sent in instructions(entries, bus):
        for servo_id, address, data in writes(sent, bus.protocol):
            for each in [servo.servo_id for servo in bus.servos] if servo_id == BROADCAST else [servo_id]:
                yield sent.t_ns, each, address, data


def values_written(
    entries: Sequence[LedgerEntry], bus: BusPlan, address: int, size: int, *, signed: bool = False
) -> Iterator[tuple[int, int, int]]:
    """Return time, servo and value of all that was written into an item by its bus, also within a block."""
    for t_ns, servo, first, data in all_writes([one for one in entries if one.bus == bus.name], bus):
        if first <= address and address + size <= first + len(data):
            yield t_ns, servo, int.from_bytes(data[address - first :][:size], "little", signed=signed)


def changes(
    entries: Sequence[LedgerEntry], plan: Plan, address: int, size: int = 4
) -> dict[int, list[tuple[float, int]]]:
    """Return what was written into an item, by servo ID: time (s) and value, as often as it changed."""
    found: dict[int, list[tuple[float, int]]] = {}
    for bus in plan.buses:
        for t_ns, servo, value in values_written(entries, bus, address, size, signed=True):
            known = found.setdefault(servo, [])
            if not known or known[-1][1] != value:
                known.append((t_ns * 1e-9, value))
    return found


def written(sent: Sequence[Instruction], bus: BusPlan, item: Item) -> Iterator[tuple[int, ServoPlan, int]]:
    """Return when which servo got which value in an item."""
    for one in sent:
        for servo_id, address, data in writes(one, bus.protocol):
            for servo in bus.servos:
                if servo_id in (servo.servo_id, BROADCAST):
                    value = value_at(servo, item, address, data)
                    if value is not None:
                        yield one.t_ns, servo, value


def states(entries: Sequence[LedgerEntry], bus: BusPlan) -> Iterator[StateReply]:
    """Return every intact state that passed the wire, wherever it is among the bytes.

    The host asks for some bytes more now and then, to distinguish a late reply from the one it waits for.
    """
    layouts = [servo.state for servo in bus.servos]
    lengths = {one.length + more for one in layouts for more in range(one.spare + 1)}
    sent = [entry for entry in entries if entry.direction == "out"]
    found = [each for entry in sent for each in _statuses(entry, bus.protocol) if len(each.data) in lengths]
    if bus.protocol == 2.0:
        found += _shared(sent, sorted(lengths))
    yield from sorted(found)


def _statuses(entry: LedgerEntry, protocol: float) -> Iterator[StateReply]:
    """Yield whole status packets, wherever they are among the bytes."""
    rest, header = entry.data, b"\xff\xff" if protocol == 1.0 else HEADER
    while (start := rest.find(header)) >= 0:
        rest = rest[start:]
        if end := packet_end(rest, protocol):
            servo_id, kind, data = opened(rest[:end], protocol)
            if protocol == 1.0:
                yield StateReply(entry.t_ns, servo_id, data)
            elif kind == STATUS:
                yield StateReply(entry.t_ns, servo_id, data[1:])
        rest = rest[1 if protocol == 1.0 else 4 :]


def _shared(sent: Sequence[LedgerEntry], lengths: Sequence[int]) -> Iterator[StateReply]:
    """Return the parts of the statuses of fast forms, up to the first broken one of each."""
    stream = b"".join(entry.data for entry in sent)
    times = [entry.t_ns for entry in sent for _ in entry.data]
    start = -1
    while (start := stream.find(HEADER + bytes((BROADCAST,)), start + 1)) >= 0:
        size = int.from_bytes(stream[start + 5 : start + 7], "little")
        for length in (one for one in lengths if (size - 1) % (one + 4) == 0):
            for at in range(start + 8, start + 7 + size, length + 4):
                end = at + 2 + length
                if end + 2 > len(stream) or crc(stream[start:end]) != int.from_bytes(
                    stream[end : end + 2], "little"
                ):
                    break
                yield StateReply(times[end + 1], stream[at + 1], stream[at + 2 : end])
