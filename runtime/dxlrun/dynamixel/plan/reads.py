"""Reads: every way in which the servos of one bus can be read once a cycle, costed; the cheapest is taken.

One instruction saves its own bytes and an adapter's latency for each servo that it asks beside the first one,
and a fast form saves seven bytes of each reply and the return delays of all but the first (protocol.md, Time
budget). Indirect addresses are no way: of each model in the control tables the state stands in one block
without a byte between its items, so there is nothing that they could leave out.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from dxlrun.dynamixel.control_table import ControlTable
from dxlrun.dynamixel.plan.bus_plan import Budget, ReadWay, ServoPlan
from dxlrun.dynamixel.plan.line import Line
from dxlrun.dynamixel.wire.transaction import Transaction

CHAIN = MappingProxyType({1.0: "bulk_read", 2.0: "sync_read"})
"""Protocol -> the capability by which several servos of one layout answer one instruction in turn."""
TEMPERATURES = ("present_temperature", "present_motor_temperature")
VOLTAGES = ("present_voltage", "present_input_voltage")
"""Names of the item in the control tables."""
TOGETHER = "bulk_read"
"""The capability by which servos of different layouts do."""
FAST = "fast_sync_read"
"""The capability by which they answer with one status packet."""


@dataclass(frozen=True, slots=True)
class Reads:
    """Which servos are read together and how: the cheapest way, and what every way costs."""

    groups: tuple[tuple[int, ...], ...]
    """Indices of servos; a group of one is read by itself."""
    plain: tuple[Transaction, ...]
    """The read of each group in the form that every firmware knows."""
    fast: tuple[bool, ...]
    """Which groups are to be read by a fast form."""
    budget: Budget
    ways: tuple[ReadWay, ...]


@dataclass(frozen=True, slots=True)
class _Way:
    groups: tuple[tuple[int, ...], ...]
    fast: tuple[bool, ...]
    reads: tuple[Transaction, ...]
    budget: Budget


def state_read(line: Line, servos: Sequence[ServoPlan], more: int = 0, *, fast: bool = False) -> Transaction:
    """Return the one read of several servos' states, each `more` bytes longer than needed."""
    return line.read_many(
        [(servo.servo_id, servo.state.address, servo.state.length + more) for servo in servos], fast=fast
    )


def slow_items(table: ControlTable) -> tuple[str, ...]:
    """Return the items that are read between the cycles where the robot file names none."""
    return tuple(name for name in table.items if name in TEMPERATURES or name in VOLTAGES)


def choose_reads(
    line: Line,
    servos: Sequence[ServoPlan],
    tables: Sequence[ControlTable],
    goals: Sequence[bytes],
) -> Reads:
    """Cost every way to read the servos of a bus, take the cheapest; of equal ones the simplest.

    `tables`: of each servo; `goals`: the packets that are written each cycle. Raises ValueError when the
    servos do not fit one instruction.
    """
    ways: dict[tuple[bytes, ...], _Way] = {}
    for groups, fast in _partitions(line, servos, tables):
        way = _way(line, servos, goals, groups, fast)
        if way is not None:
            ways.setdefault(tuple(read.packet for read in way.reads), way)
    best = min(ways.values(), key=_cost)
    return Reads(
        groups=best.groups,
        plain=tuple(_read(line, servos, group, fast=False) for group in best.groups),
        fast=best.fast,
        budget=best.budget,
        ways=tuple(ReadWay(_name(line, servos, way), way.budget, way is best) for way in ways.values()),
    )


def read_budget(line: Line, reads: Sequence[Transaction], goals: Sequence[bytes]) -> Budget:
    """Return the cost of one cycle: a sync write has no reply, so no latency counts (protocol.md)."""
    request_bytes = sum(len(read.packet) for read in reads) + sum(map(len, goals))
    reply_bytes = delays = 0
    for read in reads:
        lengths = [one.length for one in read.awaited]
        reply_bytes += read.widest if read.fast else sum(lengths) + line.dialect.OVERHEAD * len(lengths)
        delays += 1 if read.fast else len(lengths)
    return Budget(
        request_bytes=request_bytes,
        reply_bytes=reply_bytes,
        wire_ns=line.wire_ns(request_bytes + reply_bytes),
        return_delay_ns=delays * line.return_delay_ns,
        latency_ns=len(reads) * line.latency_ns,
        goal_bytes=sum(map(len, goals)),
    )


def _partitions(
    line: Line, servos: Sequence[ServoPlan], tables: Sequence[ControlTable]
) -> list[tuple[tuple[tuple[int, ...], ...], tuple[bool, ...]]]:
    """Return which servos could be read together, and which groups by a fast form; the simplest first."""
    chain = CHAIN[line.dialect.PROTOCOL]
    able = [table.capabilities for table in tables]
    alone: list[Hashable] = list(range(len(servos)))
    alike: list[Hashable] = [
        servo.state if chain in able[index] else index for index, servo in enumerate(servos)
    ]
    together: list[Hashable] = [
        TOGETHER if TOGETHER in able[index] else key for index, key in enumerate(alike)
    ]
    found = []
    for keys in (alone, alike, together):
        groups = _grouped(keys)
        found.append((groups, tuple(False for _ in groups)))
    for keys in (alike, together):
        groups = _grouped([(key, FAST in able[index]) for index, key in enumerate(keys)])
        found.append((groups, tuple(len(group) > 1 and FAST in able[group[0]] for group in groups)))
    return found


def _grouped(keys: Sequence[Hashable]) -> tuple[tuple[int, ...], ...]:
    groups: dict[Hashable, list[int]] = {}
    for index, key in enumerate(keys):
        groups.setdefault(key, []).append(index)
    return tuple(tuple(group) for group in groups.values())


def _way(
    line: Line,
    servos: Sequence[ServoPlan],
    goals: Sequence[bytes],
    groups: tuple[tuple[int, ...], ...],
    fast: tuple[bool, ...],
) -> _Way | None:
    """Return a way with its cost; None when a reply is longer than any that a receiver waits for."""
    reads = tuple(_read(line, servos, group, fast=form) for group, form in zip(groups, fast, strict=True))
    if any(read.widest > line.dialect.LONGEST for read in reads):
        return None
    return _Way(groups, fast, reads, read_budget(line, reads, goals))


def _read(line: Line, servos: Sequence[ServoPlan], group: Sequence[int], *, fast: bool) -> Transaction:
    return state_read(line, [servos[index] for index in group], fast=fast)


def _cost(way: _Way) -> int:
    return way.budget.total_ns


def _name(line: Line, servos: Sequence[ServoPlan], way: _Way) -> str:
    """Return what the e-Manual calls the instructions of a way: `fast sync read + read`."""
    names: dict[str, None] = {}
    for group, fast in zip(way.groups, way.fast, strict=True):
        blocks = {(servos[index].state.address, servos[index].state.length) for index in group}
        many = "bulk read" if line.dialect.PROTOCOL == 1.0 or len(blocks) > 1 else "sync read"
        name = "read" if len(group) == 1 else f"fast {many}" if fast else many
        names[name] = None
    return " + ".join(names)
