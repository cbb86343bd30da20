"""Reads: decides which servos and devices of a bus are read by one instruction, by the lowest cost of a
cycle.

One instruction for several servos saves its own bytes and the adapter's latency for each servo after the
first. A fast form saves seven bytes of each reply, and the return delays of all servos but the first
(protocol.md, Time budget). Indirect addresses save nothing: in every control table the state is one block
without gaps.

Devices answer after the servos of their read, so that a silent device does not affect the servos' replies.
The blocks of one device are in different reads, because an instruction must not contain an ID twice."""

from __future__ import annotations

from collections.abc import Hashable, Sequence, Set
from types import MappingProxyType

import msgspec
from msgspec.structs import replace

from dxlwire.bus_plan import SLOW_STATES, Budget, Member, ServoPlan
from dxlwire.control_table import ControlTable
from dxlwire.plan.line import TIMEOUT_MARGIN_NS, Line
from dxlwire.transaction import Transaction

CHAIN = MappingProxyType({1.0: "bulk_read", 2.0: "sync_read"})
"""Capability that servos with the same layout need to answer a single instruction in turn, by protocol."""
TOGETHER = "bulk_read"  # The same capability for servos with different layouts
FAST = "fast_sync_read"  # Capability to answer with one shared status packet


class Reads(msgspec.Struct, frozen=True):
    """The read instructions of one bus in a cycle: groups of servos and devices, each with its
    transaction."""

    groups: tuple[tuple[int, ...], ...]  # Indices of members; a group of one is a plain read
    fast: tuple[bool, ...]  # True for each group that is read by a fast form
    chosen: tuple[Transaction, ...]  # Read of each group in that form
    plain: tuple[Transaction, ...]  # Read of each group in the form that every firmware supports


def state_read(line: Line, members: Sequence[Member], more: int = 0, *, fast: bool = False) -> Transaction:
    """Return a transaction that reads the state of several members at once, servos first.

    Devices get only a short timeout once the servos have answered.

    Args:
        line: Timing of the line.
        members: Servos, then devices.
        more: Extra bytes to read from each member, limited by its spare bytes.
        fast: Use a fast form.
    """
    read = line.read_many(
        [(one.servo_id, one.address, one.length + min(more, one.spare)) for one in members], fast=fast
    )
    devices = sum(one.device >= 0 for one in members)
    if not devices:
        return read
    brief_ns = read.timeout_ns - TIMEOUT_MARGIN_NS + line.device_margin_ns
    timeout_ns = brief_ns if devices == len(members) else read.timeout_ns
    return replace(
        read,
        timeout_ns=timeout_ns,
        tail=devices,
        tail_timeout_ns=brief_ns,
        tail_margin_ns=line.device_margin_ns,
    )


def servo_read(line: Line, servo: ServoPlan) -> Transaction:
    """Return a transaction that reads position, velocity and effort of one servo."""
    state = servo.state
    return line.read_range(servo.servo_id, state.address, state.length, state.spare)


def slow_items(table: ControlTable) -> tuple[str, ...]:
    """Return the items of a model, such as temperature and voltage, that are read between cycles if the
    robot file names none."""
    return tuple(name for name in table.items if name in SLOW_STATES)


def choose_reads(
    line: Line, members: Sequence[Member], able: Sequence[Set[str]], goals: Sequence[bytes]
) -> Reads:
    """Return the read instructions of a bus that cost the least time per cycle; among equal ones the
    simplest.

    Args:
        line: Timing of the line.
        members: Blocks to read in each cycle.
        able: Capabilities of each member.
        goals: Packets that are written in each cycle.

    Raises:
        ValueError: No grouping has replies that fit into the longest packet.
    """

    def laid(groups: Sequence[Sequence[int]], fast: Sequence[bool]) -> tuple[Transaction, ...]:
        return tuple(
            state_read(line, [members[index] for index in group], fast=form)
            for group, form in zip(groups, fast, strict=True)
        )

    ways = [
        Reads(groups, fast, laid(groups, fast), laid(groups, [False] * len(groups)))
        for groups, fast in _partitions(line, members, able)
    ]
    receivable = [way for way in ways if all(read.widest <= line.dialect.LONGEST for read in way.chosen)]
    return min(receivable, key=lambda way: read_budget(line, way.chosen, goals).total_ns)


def read_budget(line: Line, reads: Sequence[Transaction], goals: Sequence[bytes]) -> Budget:
    """Return bytes and time of one cycle with these reads and goal packets. A sync write has no reply, so
    it adds no latency (protocol.md)."""
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
    line: Line, members: Sequence[Member], able: Sequence[Set[str]]
) -> list[tuple[tuple[tuple[int, ...], ...], tuple[bool, ...]]]:
    """Return each possible grouping of the members with True for the groups that use a fast form; the
    simplest first."""
    chain = CHAIN[line.dialect.PROTOCOL]
    alone: list[Hashable] = list(range(len(members)))
    alike: list[Hashable] = [
        (one.address, one.length, one.spare, one.block) if chain in able[index] else index
        for index, one in enumerate(members)
    ]
    together: list[Hashable] = [
        (TOGETHER, one.block) if TOGETHER in able[index] else alike[index]
        for index, one in enumerate(members)
    ]
    found = []
    for keys in (alone, alike, together):
        groups = _grouped(keys)
        found.append((groups, tuple(False for _ in groups)))
    for keys in (alike, together):
        # A fast form needs the capability in every servo of a group, so groups are split by it.
        groups = _grouped([(key, FAST in able[index]) for index, key in enumerate(keys)])
        found.append((groups, tuple(len(group) > 1 and FAST in able[group[0]] for group in groups)))
    return found


def _grouped(keys: Sequence[Hashable]) -> tuple[tuple[int, ...], ...]:
    groups: dict[Hashable, list[int]] = {}
    for index, key in enumerate(keys):
        groups.setdefault(key, []).append(index)
    return tuple(tuple(group) for group in groups.values())


def read_by(protocol: float, members: Sequence[Member], reads: Reads) -> str:
    """Return the e-Manual's names of the instructions that these reads use: `fast sync read + read`."""
    names: dict[str, None] = {}
    for group, fast in zip(reads.groups, reads.fast, strict=True):
        blocks = {(members[index].address, members[index].length) for index in group}
        many = "bulk read" if protocol == 1.0 or len(blocks) > 1 else "sync read"
        names["read" if len(group) == 1 else f"fast {many}" if fast else many] = None
    return " + ".join(names)
