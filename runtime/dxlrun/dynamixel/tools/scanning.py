"""Scanning: which servos answer on a line, in which protocol and at which rate; nothing is written.

Protocol 2.0 gets one broadcast ping a rate, which each servo answers in a slot of its own; Protocol 1.0 is
pinged ID by ID, because all its servos would answer at once (e-Manual, Protocol 1.0 and 2.0, Ping). So is
Protocol 2.0 at a rate where something answered: boards that are built with the maker's Dynamixel2Arduino take
no part in a broadcast ping (utility/slave.cpp). Where anything is received that is no whole reply every ID is
pinged again, with longer timeouts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import msgspec
from msgspec import structs
from msgspec.structs import replace

from dxlrun.dynamixel.remedies import CHECK, choose_remedy
from dxlrun.dynamixel.tools.tool_line import ToolLine, refuse_echo
from dxlwire.control_table import ControlItem, ControlTable, all_tables, models_by_number
from dxlwire.control_table.devices import devices_by_number
from dxlwire.plan.line import MOST_SPARE, Line, listen
from dxlwire.plan.retry import ATTEMPTS, extend_timeouts, retry
from dxlwire.transaction import BROADCAST_ID, Outcome, Program, Reply, Transaction
from dxlwire.wire.dialect import dialect_of

SHORT_TIMEOUT_NS = 2_000_000
"""How long a reply that probably does not come is awaited beyond the latest moment by the wire."""
SLOT_NS = 3_000_000
"""After a broadcast ping: of each ID, beside the bytes of its answer (dynamixel-sdk, broadcastPing)."""
LATE_NS = 20_000_000  # After the last request at a rate: what still comes was late in the adapter
LATE_OF_FEW_NS = 100_000_000
"""The same where few IDs are pinged: there it may be the machine that is late."""
FEW = 20  # So many IDs are quicker pinged one by one
_USUAL = (1_000_000, 57_600, 115_200)
_IDENTITY_LENGTH = 3
"""Model number (2) and firmware version (1): the reply to a ping of Protocol 2.0, bytes 0..2 in 1.0."""
_LIMITS = (("min_position_limit", "max_position_limit"), ("cw_angle_limit", "ccw_angle_limit"))
_TRIES = 2  # Of a ping at a rate that is one of many
_TRIES_ALONE = 4  # Where protocol and rate are given: there it is awaited with longer timeouts


class FoundServo(msgspec.Struct, frozen=True):
    """A servo that answered."""

    protocol: float
    baud_rate: int  # bit/s
    servo_id: int
    model: str = ""  # Name of its control table; empty where there is none, or it is not known
    model_number: int = -1  # -1: not known
    firmware: int = 0
    position: int | None = None  # Present position, ticks
    return_delay: int | None = None  # ns
    lowest: int | None = None  # Its own limits of the position, ticks; both 0 in wheel mode
    highest: int | None = None
    device: bool = False  # True when it is no servo: an IMU, a power board
    garbled: bool = False  # True when it answers garbled, as two servos of one ID do
    remarks: tuple[str, ...] = ()  # What a person should know

    @property
    def models(self) -> frozenset[str]:
        """Models of servos with its model number and firmware; some share a number."""
        tables = models_by_number(self.model_number, self.protocol, self.firmware)
        return frozenset(table.model for table in tables)


class Search(msgspec.Struct, frozen=True):
    """Protocols, rates and IDs to look at."""

    protocols: tuple[float, ...] = (2.0, 1.0)
    baud_rates: tuple[int, ...] = ()  # bit/s; empty: all that a control table of the protocol knows
    ids: tuple[int, ...] = ()  # Empty: all that the protocol has

    def lines(self) -> tuple[tuple[float, int], ...]:
        """Return each protocol with each rate."""
        return tuple(
            (protocol, rate)
            for protocol in self.protocols
            for rate in self.baud_rates or known_rates(protocol)
        )


EVERYWHERE = Search()
Progress = Callable[[str, float], None]


def known_rates(protocol: float) -> tuple[int, ...]:
    """Return the rates that servos of a protocol can have, bit/s, the usual ones first."""
    rates = {
        rate for table in all_tables() if table.protocol == protocol for rate in table.baud_rates.values()
    }
    return tuple(sorted(rates, key=lambda rate: (rate not in _USUAL, -rate)))


class Scanned(msgspec.Struct, frozen=True):
    """What a scan found."""

    servos: tuple[FoundServo, ...]
    left_out: tuple[int, ...]  # Rates at which the adapter cannot run, bit/s


def scan(tool: ToolLine, search: Search = EVERYWHERE, progress: Progress = lambda *_: None) -> Scanned:
    """Look for servos; raises PortError when the line is gone, or its adapter echoes."""
    found: list[FoundServo] = []
    left_out: list[int] = []
    lines = search.lines()
    for index, (protocol, baud_rate) in enumerate(lines):
        if not tool.speak(protocol, baud_rate):
            left_out.append(baud_rate)
            continue
        words = f"Protocol {protocol} at {baud_rate} bit/s, {len(found)} found"

        def beat(share: float, index: int = index, words: str = words) -> None:
            progress(words, (index + share) / len(lines))

        ids = search.ids or tuple(range(dialect_of(protocol).HIGHEST_ID + 1))
        beat(0.0)
        found += tool.run(_search(tool, ids, beat))
    return Scanned(tuple(found), tuple(dict.fromkeys(left_out)))


def find_servo(tool: ToolLine, servo_id: int, search: Search = EVERYWHERE) -> tuple[FoundServo, ...]:
    """Look for one ID in every protocol and at every rate; raises PortError as `scan` does."""
    found: list[FoundServo] = []
    lines = search.lines()
    tries = _TRIES_ALONE if len(lines) == 1 else _TRIES
    for protocol, baud_rate in lines:
        if servo_id <= dialect_of(protocol).HIGHEST_ID and tool.speak(protocol, baud_rate):
            found += tool.run(_find(tool, servo_id, tries))
    return tuple(found)


def _find(tool: ToolLine, servo_id: int, tries: int) -> Program[list[FoundServo]]:
    knocked = _knock(tool, servo_id, tries)
    if (yield from (extend_timeouts(knocked) if tries == _TRIES_ALONE else knocked)):
        return [(yield from extend_timeouts(look(tool.line, servo_id, tool.port.name)))]
    return []


def _knock(tool: ToolLine, servo_id: int, tries: int) -> Program[bool]:
    for _ in range(tries):
        reply = yield tool.line.ping(servo_id)
        refuse_echo(tool.port.name, reply)
        if reply.outcome is not Outcome.TIMEOUT:
            return True
    return False


def _search(tool: ToolLine, ids: Sequence[int], beat: Callable[[float], None]) -> Program[list[FoundServo]]:
    line, heard = tool.line, tool.heard
    yield listen(LATE_NS)  # what still comes of the rate before
    heard.clear()
    if line.dialect.PING_LENGTH >= _IDENTITY_LENGTH and len(ids) > FEW:
        slot_ns = line.wire_ns(line.dialect.OVERHEAD + line.dialect.PING_LENGTH) + SLOT_NS
        ping = line.unanswered(line.dialect.ping(BROADCAST_ID))
        slots_ns = slot_ns * (len(ids) + 1) + line.latency_ns
        refuse_echo(tool.port.name, (yield structs.replace(ping, due_ns=ping.due_ns + slots_ns)))
        there = heard.ids & set(ids)
        if there:  # boards of the maker's Slave class, which answer no ping to all, share a line with servos
            rest = [servo_id for servo_id in ids if servo_id not in there]
            there |= yield from _one_by_one(tool, rest, SHORT_TIMEOUT_NS, beat)
    else:
        there = yield from _one_by_one(tool, ids, SHORT_TIMEOUT_NS, beat)
    if heard.noise:
        there |= yield from _one_by_one(tool, ids, None, beat)
    found: list[FoundServo] = []
    for servo_id in sorted(there):
        found.append((yield from extend_timeouts(look(line, servo_id, tool.port.name))))
    return found


def _one_by_one(
    tool: ToolLine, ids: Sequence[int], timeout_ns: int | None, beat: Callable[[float], None]
) -> Program[set[int]]:
    """Ping every ID; return those that are there, or seem to be."""
    line, heard = tool.line, tool.heard
    there: set[int] = set()
    suspected: list[int] = []
    for index, servo_id in enumerate(ids):
        ping = line.ping(servo_id)
        reply = yield ping if timeout_ns is None else _hurried(tool, ping, timeout_ns)
        refuse_echo(tool.port.name, reply)
        if reply.answered:
            there.add(servo_id)
        elif reply.outcome is not Outcome.TIMEOUT:
            suspected.append(servo_id)
        beat((index + 1) / len(ids))
    yield listen(LATE_NS if len(ids) > FEW else LATE_OF_FEW_NS)
    there |= yield from extend_timeouts(_answering(line, suspected))
    return there | (heard.ids & set(ids))


def _answering(line: Line, suspected: Sequence[int]) -> Program[set[int]]:
    """Ping each again: what came may have been the late answer of the one before."""
    there: set[int] = set()
    for servo_id in suspected:
        reply = yield from retry(line.ping(servo_id))
        if reply.outcome is not Outcome.TIMEOUT:
            there.add(servo_id)
    return there


def _hurried(tool: ToolLine, transaction: Transaction, timeout_ns: int) -> Transaction:
    return structs.replace(transaction, timeout_ns=transaction.due_ns + tool.port.latency_ns + timeout_ns)


def identity(line: Line, servo_id: int) -> Program[tuple[Reply, Reply]]:
    """Ping a servo; return the reply to that, and the one with its model number and firmware version."""
    ping = yield from retry(line.ping(servo_id))
    if not ping.answered or line.dialect.PING_LENGTH >= _IDENTITY_LENGTH:
        return ping, ping
    return ping, (yield from retry(line.read(servo_id, 0, _IDENTITY_LENGTH, MOST_SPARE)))


def look(line: Line, servo_id: int, port: str) -> Program[FoundServo]:
    """Read the model and settings of a servo that is there, on a port of this name; writes nothing."""
    dialect = line.dialect
    servo = FoundServo(dialect.PROTOCOL, line.baud_rate, servo_id)
    ping, reply = yield from identity(line, servo_id)
    if not reply.answered:
        garbled = Outcome.GARBLED in (ping.outcome, reply.outcome)
        return replace(servo, garbled=garbled, remarks=(_mute(ping, reply, line, port),))
    number, firmware = reply.word(), reply.parameters[2]
    remarks = [dialect.describe_error(reply.error)] if reply.error else []
    table = next(iter(models_by_number(number, dialect.PROTOCOL, firmware)), None)
    device = next(iter(devices_by_number(number, dialect.PROTOCOL)), None)
    if table is None and device is not None:
        known = replace(servo, model=device.model, model_number=number, firmware=firmware, device=True)
        return (
            yield from _look_closer(
                line, device.items, device.spare, replace(known, remarks=tuple(remarks)), port
            )
        )
    if table is None:
        remarks.append(f"no control table has its model number {number}: a plug-in can add one")
        return replace(servo, model_number=number, firmware=firmware, remarks=tuple(remarks))
    if reply.error and (named := (yield from _hardware_error(line, servo_id, table))):
        remarks = [named]
    servo = replace(servo, model=table.model, model_number=number, firmware=firmware, remarks=tuple(remarks))
    return (yield from _look_closer(line, table.items, table.spare, servo, port))


def _hardware_error(line: Line, servo_id: int, table: ControlTable) -> Program[str]:
    """Read the item that reports hardware errors; return its meaning, or nothing where it reports none."""
    item = table.items.get(table.errors.item)
    if item is None:
        return ""
    spare = table.spare(item.address + item.size, MOST_SPARE)
    reply = yield from retry(line.read(servo_id, item.address, item.size, spare))
    value = reply.parameters[0] if reply.answered else 0
    return f"{item.title} is {value}: {table.errors.describe(value)}" if value else ""


def _look_closer(
    line: Line,
    table: Mapping[str, ControlItem],
    spare: Callable[[int, int], int],
    servo: FoundServo,
    port: str,
) -> Program[FoundServo]:
    """Read what a robot file needs, and find two servos of one ID: their positions differ."""
    values: dict[str, int] = {}
    names = ["present_position", "return_delay_time", *(name for pair in _LIMITS for name in pair)]
    items = [table[name] for name in names if name in table]
    silent: list[str] = []
    garbled = False
    for item in items:
        more = spare(item.address + item.size, MOST_SPARE)
        reply = yield from retry(line.read(servo.servo_id, item.address, item.size, more))
        if reply.answered:
            values[item.name] = item.decode(reply.parameters)
        else:
            silent.append(item.title)
        garbled = garbled or reply.outcome is Outcome.GARBLED or bool(reply.strays)
    remarks = list(servo.remarks)
    if garbled:
        remedy = choose_remedy(port, " If not, check its cable", simulated="")
        remarks.append(f"answers garbled now and then: do two servos have this ID?{remedy}")
    elif silent:
        remedy = choose_remedy(port, CHECK)
        remarks.append(f"did not answer {ATTEMPTS} reads of {', '.join(silent)}: {remedy}")
    lowest, highest = next((pair for pair in _LIMITS if pair[0] in values and pair[1] in values), ("", ""))
    delay = values.get("return_delay_time")
    return replace(
        servo,
        position=values.get("present_position"),
        return_delay=None if delay is None else delay * 2_000,
        lowest=values.get(lowest),
        highest=values.get(highest),
        garbled=garbled,
        remarks=tuple(remarks),
    )


def _mute(ping: Reply, reply: Reply, line: Line, port: str) -> str:
    if Outcome.GARBLED in (ping.outcome, reply.outcome):
        remedy = choose_remedy(port, " If not, check cable and ground", simulated="")
        return f"answers garbled: do two servos have this ID?{remedy}"
    if not ping.answered:
        return f"answered once, and then no more: {choose_remedy(port, CHECK)}"
    if reply.outcome is Outcome.REFUSED:
        return f"refuses to be read: {line.dialect.describe_error(reply.error)}"
    remedy = choose_remedy(port, f"{CHECK}, and its Status Return Level (16)")
    return f"answered a ping, but did not answer {ATTEMPTS} reads of its model number: {remedy}"
