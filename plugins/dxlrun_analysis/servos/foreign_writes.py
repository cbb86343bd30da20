"""Writes of other hosts to servos of the plan: written items, and failures of these servos afterwards.

A single instruction is sufficient evidence, because noise hardly looks like one: it is intact, has the ID of
a servo, and begins and ends at items of its control table. Sources: ROBOTIS e-Manual, Protocol 1.0 and 2.0,
Write, Reg Write, Sync Write, Bulk Write, Factory Reset and Reboot.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from dxlrun.tooling.records import Event, EventCode, LoggedPacket
from dxlrun_analysis.finding import HURTS, listed
from dxlrun_analysis.plan_excerpt import LoggedBus, LoggedServo
from dxlwire import BROADCAST_ID, find_table, protocol1, protocol2

_AFTER_NS = 2_000_000_000  # A failure within this time after a write is attributed to the write
_MOST_KEPT = 1000  # Bounds memory
_MOST_NAMED = 3
_HEADER_2 = b"\xff\xff\xfd\x00"
_WRITES = (protocol1.Protocol1Instruction.WRITE, protocol1.Protocol1Instruction.REG_WRITE)
_RESETS = {
    protocol2.Protocol2Instruction.REBOOT: "a reboot",
    protocol2.Protocol2Instruction.FACTORY_RESET: "a factory reset",
}


class _Write(NamedTuple):
    """Write of one control table item of one servo by another host, or a reboot or factory reset."""

    t_ns: int
    bus: int
    servo_id: int
    name: str  # Name of the joint
    what: str  # `baud_rate`, or `a reboot`
    value: int | None


class ForeignWrites:
    """Accumulator of writes by other hosts, and of servo failures that may result from them."""

    def __init__(self) -> None:
        self._writes: list[_Write] = []
        self._failures: list[Event] = []

    def add_write(self, bus: int, plan: LoggedBus, packet: LoggedPacket) -> None:
        """Add the writes in an instruction packet of another host."""
        if len(self._writes) < _MOST_KEPT:
            self._writes += _written(bus, plan, packet)

    def add_failure(self, event: Event) -> None:
        """Keep an event that reports a lost, rebooted or limp servo; ignore others."""
        if event.code in HURTS and len(self._failures) < _MOST_KEPT:
            self._failures.append(event)

    def describe_writes(self, bus: int) -> tuple[str, bool]:
        """Return the writes on a bus as the end of a sentence, empty without any; and whether a written
        servo failed within 2 s."""
        writes = [one for one in self._writes if one.bus == bus]
        ends = {
            one.name: event
            for event in reversed(self._failures)
            for one in writes
            if one.name == event.source and 0 <= event.t_ns - one.t_ns <= _AFTER_NS
        }
        told = [one for one in writes if one.name in ends] or writes
        parts = []
        # Servos that did not fail are listed by ID only, because nothing is wrong with them.
        by_items: dict[str, list[tuple[int, str]]] = {}
        for servo_id in dict.fromkeys(one.servo_id for one in told):
            last = {one.what: one for one in told if one.servo_id == servo_id}
            shown = list(last.values())[-_MOST_NAMED:]
            items = " and ".join(
                f"{one.what}{'' if one.value is None else f' = {one.value}'}" for one in shown
            )
            if (name := shown[-1].name) in ends:
                then = HURTS[EventCode(ends[name].code)]
                parts.append(f"{items} to {name} (ID {servo_id}) before it {then}")
            else:
                by_items.setdefault(" and ".join(last), []).append((servo_id, items))
        for names, each in by_items.items():
            ids = [str(servo_id) for servo_id, _ in each]
            items = each[0][1] if len({items for _, items in each}) == 1 else names
            parts.append(f"{items} to {'IDs' if len(ids) > 1 else 'ID'} {listed(ids)}")
        more = f"; and to {len(parts) - _MOST_NAMED} more" if len(parts) > _MOST_NAMED else ""
        return "; ".join(parts[:_MOST_NAMED]) + more, bool(ends)


def _written(bus: int, plan: LoggedBus, packet: LoggedPacket) -> Iterator[_Write]:
    """Yield the items of the plan's servos that an instruction writes, and their reboots and resets."""
    data = packet.data
    second = data.startswith(_HEADER_2)
    at = 4 if second else 2
    if len(data) <= at + (3 if second else 2):
        return
    code = data[at + 3] if second else data[at + 2]
    if code in _RESETS:
        for servo in _addressed(plan, data[at]):
            what = _RESETS[protocol2.Protocol2Instruction(code)]
            yield _Write(packet.first_ns, bus, servo.servo_id, servo.joint, what, None)
        return
    body = protocol2.unstuffed(data[8:-2]) if second else data[5:-1]
    for servo_id, address, written in _parts(data[at], code, body, 2 if second else 1):
        for servo in _addressed(plan, servo_id):
            for name, value in _items(plan, servo, address, written):
                yield _Write(packet.first_ns, bus, servo.servo_id, servo.joint, name, value)


def _parts(servo_id: int, code: int, body: bytes, width: int) -> Iterator[tuple[int, int, bytes]]:
    """Yield ID, address and data of each write in an instruction with this code and body; addresses and
    sizes have `width` bytes."""
    if code in _WRITES:
        yield servo_id, int.from_bytes(body[:width], "little"), body[width:]
    elif code == protocol2.Protocol2Instruction.SYNC_WRITE:
        address, size = (int.from_bytes(body[at : at + width], "little") for at in (0, width))
        for at in range(2 * width, len(body) - size, size + 1):
            yield body[at], address, body[at + 1 : at + 1 + size]
    elif code == protocol2.Protocol2Instruction.BULK_WRITE:
        at = 0
        while at + 5 <= len(body):
            address, size = (int.from_bytes(body[at + i : at + i + 2], "little") for i in (1, 3))
            yield body[at], address, body[at + 5 : at + 5 + size]
            at += 5 + size


def _addressed(plan: LoggedBus, servo_id: int) -> list[LoggedServo]:
    return [servo for servo in plan.servos if servo_id in (servo.servo_id, BROADCAST_ID)]


def _items(plan: LoggedBus, servo: LoggedServo, address: int, data: bytes) -> list[tuple[str, int]]:
    """Return name and value of the items that exactly cover the written bytes, or an empty list."""
    try:
        items = find_table(servo.model, plan.protocol).items
    except LookupError:  # The model of a plug-in that is not installed here
        return []
    sizes = {item.address: (name, item.size) for name, item in items.items()}
    found, at = [], 0
    while at < len(data):
        name, size = sizes.get(address + at, ("", 0))
        if not name or at + size > len(data):
            return []
        found.append((name, int.from_bytes(data[at : at + size], "little")))
        at += size
    return found
