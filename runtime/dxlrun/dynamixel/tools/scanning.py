"""Scanning: finds the servos and devices on a port by ping, with protocol and rate; nothing is written.

Protocol 2.0 gets one broadcast ping per rate, which each servo answers in its own slot. Protocol 1.0 is
pinged ID by ID, because all its servos would answer a broadcast at once (e-Manual, Protocol 1.0 and 2.0,
Ping). Protocol 2.0 is also pinged ID by ID at a rate where a node answered: boards with the maker's
Dynamixel2Arduino do not answer a broadcast ping (utility/slave.cpp). After bytes that are not a whole reply
every ID is pinged again, with longer timeouts. Few IDs at one rate are, too, if none answers: a packet may be
lost, and a busy machine late.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import msgspec
from msgspec.structs import replace

from dxlrun.dynamixel.remedies import CHECK, choose_remedy
from dxlrun.dynamixel.tools.tool_line import ToolLine, refuse_echo
from dxlwire.bus.programs import IDENTITY_LENGTH, SHORT_TIMEOUT_NS, SLOT_NS, identity
from dxlwire.control_table import ControlItem, ControlTable, all_tables, models_by_number
from dxlwire.control_table.device_models import devices_by_number
from dxlwire.plan.line import MOST_SPARE, Line, listen_transaction
from dxlwire.plan.retry import ATTEMPTS, extend_timeouts, retry
from dxlwire.transaction import BROADCAST_ID, Program, Reply, TransactionOutcome
from dxlwire.wire.dialect import dialect_of

LATE_NS = 20_000_000  # listening time after the last request at a rate, for replies that the adapter delays
LATE_OF_FEW_NS = 100_000_000
"""Listening time (ns) like LATE_NS, but if few IDs are pinged: then the machine may be late, too."""
DISCARD_NS = 110_000_000
"""Listening time (ns) before pings of Protocol 1.0: its servos take bytes of Protocol 2.0 for the beginning
of a packet, and discard it after a pause of 100 ms (protocol.md, Line).
"""
FEW = 20  # up to this many IDs, single pings are faster than a broadcast
_USUAL = (1_000_000, 57_600, 115_200)
_LIMITS = (("min_position_limit", "max_position_limit"), ("cw_angle_limit", "ccw_angle_limit"))
_TRIES = 2  # pings at each of several rates
_TRIES_ALONE = 4  # pings if protocol and rate are given; their timeouts are longer


class FoundServo(msgspec.Struct, frozen=True):
    """A servo or device that answered a scan, with the values that a robot file needs."""

    protocol: float
    baud_rate: int  # bit/s
    servo_id: int
    model: str = ""  # name of its control table; empty: unknown
    model_number: int = -1  # -1: not known
    firmware: int = 0
    position: int | None = None  # present position, ticks
    return_delay: int | None = None  # ns
    lowest: int | None = None  # its own position limits, ticks; both 0 in wheel mode
    highest: int | None = None
    device: bool = False  # True for a device that is not a servo: an IMU, a power board
    garbled: bool = False  # True if its answers are garbled, as those of two servos with one ID
    remarks: tuple[str, ...] = ()  # remarks for the user

    @property
    def models(self) -> frozenset[str]:
        """Names of all models with this model number and firmware; some models share a number."""
        tables = models_by_number(self.model_number, self.protocol, self.firmware)
        return frozenset(table.model for table in tables)


class Search(msgspec.Struct, frozen=True):
    """Protocols, baud rates and IDs that a scan tries."""

    protocols: tuple[float, ...] = (2.0, 1.0)
    baud_rates: tuple[int, ...] = ()  # bit/s; empty: all rates in the protocol's control tables
    ids: tuple[int, ...] = ()  # empty: all IDs of the protocol

    def lines(self) -> tuple[tuple[float, int], ...]:
        """Return every (protocol, baud rate in bit/s) that the scan tries."""
        return tuple(
            (protocol, rate)
            for protocol in self.protocols
            for rate in self.baud_rates or known_rates(protocol)
        )


EVERYWHERE = Search()
Progress = Callable[[str, float], None]


def known_rates(protocol: float) -> tuple[int, ...]:
    """Return the baud rates (bit/s) that the control tables of a protocol have, the usual ones first."""
    rates = {
        rate for table in all_tables() if table.protocol == protocol for rate in table.baud_rates.values()
    }
    return tuple(sorted(rates, key=lambda rate: (rate not in _USUAL, -rate)))


class ScanResult(msgspec.Struct, frozen=True):
    """Result of a scan of one port."""

    servos: tuple[FoundServo, ...]
    left_out: tuple[int, ...]  # rates that the adapter does not support, bit/s


def scan(tool: ToolLine, search: Search = EVERYWHERE, progress: Progress = lambda *_: None) -> ScanResult:
    """Search a port for servos and devices; `progress` receives a text and the fraction done.

    Raises:
        PortError: The line is gone, or its adapter echoes.
    """
    found: list[FoundServo] = []
    left_out: list[int] = []
    lines = search.lines()
    again = len(lines) == 1 and 0 < len(search.ids) <= FEW
    for index, (protocol, baud_rate) in enumerate(lines):
        if not tool.speak(protocol, baud_rate):
            left_out.append(baud_rate)
            continue
        words = f"Protocol {protocol} at {baud_rate} bit/s, {len(found)} found"

        def beat(share: float, index: int = index, words: str = words) -> None:
            progress(words, (index + share) / len(lines))

        ids = search.ids or tuple(range(dialect_of(protocol).HIGHEST_ID + 1))
        beat(0.0)
        found += tool.run_program(_search(tool, ids, beat, again=again))
    return ScanResult(tuple(found), tuple(dict.fromkeys(left_out)))


def find_servo(tool: ToolLine, servo_id: int, search: Search = EVERYWHERE) -> tuple[FoundServo, ...]:
    """Search a port for one ID in every protocol and at every rate; raise PortError as `scan` does."""
    found: list[FoundServo] = []
    lines = search.lines()
    tries = _TRIES_ALONE if len(lines) == 1 else _TRIES
    for protocol, baud_rate in lines:
        if servo_id <= dialect_of(protocol).HIGHEST_ID and tool.speak(protocol, baud_rate):
            found += tool.run_program(_find(tool, servo_id, tries))
    return tuple(found)


def _find(tool: ToolLine, servo_id: int, tries: int) -> Program[list[FoundServo]]:
    knocked = _knock(tool, servo_id, tries)
    if (yield from (extend_timeouts(knocked) if tries == _TRIES_ALONE else knocked)):
        return [(yield from extend_timeouts(read_servo(tool.line, servo_id, tool.port.name)))]
    return []


def _knock(tool: ToolLine, servo_id: int, tries: int) -> Program[bool]:
    for _ in range(tries):
        reply = yield tool.line.ping(servo_id)
        refuse_echo(tool.port.name, reply)
        if reply.outcome is not TransactionOutcome.TIMEOUT:
            return True
    return False


def _search(
    tool: ToolLine, ids: Sequence[int], beat: Callable[[float], None], *, again: bool
) -> Program[list[FoundServo]]:
    line, heard = tool.line, tool.heard
    # Replies of the previous rate are still to come.
    yield listen_transaction(DISCARD_NS if line.dialect.PROTOCOL == 1.0 else LATE_NS)
    heard.clear_records()
    # Only Protocol 2.0, whose ping replies contain the model number, has a broadcast ping with slots.
    if line.dialect.PING_LENGTH >= IDENTITY_LENGTH and len(ids) > FEW:
        slot_ns = line.wire_ns(line.dialect.OVERHEAD + line.dialect.PING_LENGTH) + SLOT_NS
        ping = line.unanswered(line.dialect.ping(BROADCAST_ID))
        slots_ns = slot_ns * (len(ids) + 1) + line.latency_ns
        refuse_echo(tool.port.name, (yield replace(ping, due_ns=ping.due_ns + slots_ns)))
        there = heard.ids & set(ids)
        # Boards with the maker's Slave class, which do not answer a broadcast ping, may share the line.
        if there:
            rest = [servo_id for servo_id in ids if servo_id not in there]
            there |= yield from _one_by_one(tool, rest, SHORT_TIMEOUT_NS, beat)
    else:
        there = yield from _one_by_one(tool, ids, SHORT_TIMEOUT_NS, beat)
    # Noise may be replies that collided: ping every ID with full timeouts.
    if heard.noise:
        there |= yield from _one_by_one(tool, ids, None, beat)
    if again and not there:
        there = yield from extend_timeouts(_ping_again(tool, ids, beat))
    found: list[FoundServo] = []
    for servo_id in sorted(there):
        found.append((yield from extend_timeouts(read_servo(line, servo_id, tool.port.name))))
    return found


def _one_by_one(
    tool: ToolLine, ids: Sequence[int], timeout_ns: int | None, beat: Callable[[float], None]
) -> Program[set[int]]:
    """Ping every ID one after the other and return the IDs that answered.

    An ID with a damaged reply counts if a second ping is answered, too, or a late reply names it.
    """
    line, heard = tool.line, tool.heard
    there: set[int] = set()
    suspected: list[int] = []
    for index, servo_id in enumerate(ids):
        ping = line.ping(servo_id)
        if timeout_ns is not None:
            ping = replace(ping, timeout_ns=ping.due_ns + tool.port.latency_ns + timeout_ns)
        reply = yield ping
        refuse_echo(tool.port.name, reply)
        if reply.answered:
            there.add(servo_id)
        elif reply.outcome is not TransactionOutcome.TIMEOUT:
            suspected.append(servo_id)
        beat((index + 1) / len(ids))
    yield listen_transaction(LATE_NS if len(ids) > FEW else LATE_OF_FEW_NS)
    there |= yield from extend_timeouts(_answering(line, suspected))
    return there | (heard.ids & set(ids))


def _ping_again(tool: ToolLine, ids: Sequence[int], beat: Callable[[float], None]) -> Program[set[int]]:
    there: set[int] = set()
    for _ in range(_TRIES_ALONE - 1):
        there = there or (yield from _one_by_one(tool, ids, None, beat))
    return there


def _answering(line: Line, suspected: Sequence[int]) -> Program[set[int]]:
    """Ping each ID with a damaged reply again and return those that reply: the bytes may have been a late
    answer of the previous ID.
    """
    there: set[int] = set()
    for servo_id in suspected:
        reply = yield from retry(line.ping(servo_id))
        if reply.outcome is not TransactionOutcome.TIMEOUT:
            there.add(servo_id)
    return there


def read_servo(line: Line, servo_id: int, port: str) -> Program[FoundServo]:
    """Read model and settings of a servo or device that answered a ping; `port` is the port's name. Writes
    nothing.
    """
    dialect = line.dialect
    servo = FoundServo(dialect.PROTOCOL, line.baud_rate, servo_id)
    ping, reply = yield from identity(line, servo_id)
    if not reply.answered:
        garbled = TransactionOutcome.GARBLED in (ping.outcome, reply.outcome)
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
        remarks.append(f"no control table has its model number {number}: add one with a plug-in")
        return replace(servo, model_number=number, firmware=firmware, remarks=tuple(remarks))
    if reply.error and (named := (yield from _hardware_error(line, servo_id, table))):
        remarks = [named]
    servo = replace(servo, model=table.model, model_number=number, firmware=firmware, remarks=tuple(remarks))
    return (yield from _look_closer(line, table.items, table.spare, servo, port))


def _hardware_error(line: Line, servo_id: int, table: ControlTable) -> Program[str]:
    """Read a servo's item with hardware errors; return the errors in words, empty if there are none or no
    reply came.
    """
    item = table.items.get(table.errors.item)
    if item is None:
        return ""
    spare = table.spare(item.address + item.size, MOST_SPARE)
    reply = yield from retry(line.read_range(servo_id, item.address, item.size, spare))
    value = reply.parameters[0] if reply.answered else 0
    return f"{item.title} is {value}: {table.errors.describe_errors(value)}" if value else ""


def _look_closer(
    line: Line,
    table: Mapping[str, ControlItem],
    spare: Callable[[int, int], int],
    servo: FoundServo,
    port: str,
) -> Program[FoundServo]:
    """Add position, return delay and limits of a node to its record. Garbled replies, as of two servos with
    one ID, become a remark.
    """
    values: dict[str, int] = {}
    names = ["present_position", "return_delay_time", *(name for pair in _LIMITS for name in pair)]
    items = [table[name] for name in names if name in table]
    silent: list[str] = []
    garbled = False
    for item in items:
        more = spare(item.address + item.size, MOST_SPARE)
        reply = yield from retry(line.read_range(servo.servo_id, item.address, item.size, more))
        if reply.answered:
            values[item.name] = item.decode(reply.parameters)
        else:
            silent.append(item.title)
        garbled = garbled or reply.outcome is TransactionOutcome.GARBLED or bool(reply.strays)
    remarks = list(servo.remarks)
    if garbled:
        remedy = choose_remedy(port, " If not, check its cable", simulated="")
        remarks.append(f"sends garbled replies now and then: do two servos have this ID?{remedy}")
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
    if TransactionOutcome.GARBLED in (ping.outcome, reply.outcome):
        remedy = choose_remedy(port, " If not, check cable and ground", simulated="")
        return f"sends garbled replies: do two servos have this ID?{remedy}"
    if not ping.answered:
        return f"answered only once: {choose_remedy(port, CHECK)}"
    if reply.outcome is TransactionOutcome.REFUSED:
        return f"rejects reads: {line.dialect.describe_error(reply.error)}"
    remedy = choose_remedy(port, f"{CHECK}, and its Status Return Level (16)")
    return f"answered a ping, but did not answer {ATTEMPTS} reads of its model number: {remedy}"
