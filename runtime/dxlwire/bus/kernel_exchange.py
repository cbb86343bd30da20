"""Kernel exchange: a reader and a writer, which exchange the same items of the same servos again and again.

Both use the exchange of the runtime. To the compiled kernel the servos of a reader are devices: units with
any number of items, without joint or mode. A writer is one sync write for each block of adjacent items."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlwire.bus.item_values import item_of, tick_range
from dxlwire.bus.programs import Addressed
from dxlwire.bus.servo_rows import ReadRows, ServoRows, WrittenRows, writable_item
from dxlwire.bus.session import Session
from dxlwire.bus_plan import BusPlan, DevicePlan, GoalLayout, members_of
from dxlwire.control_table import ControlItem
from dxlwire.control_table.control_items import side_by_side
from dxlwire.exchange.arrays import Floats
from dxlwire.exchange.cyclic_exchange import CyclicExchange
from dxlwire.exchange.cyclic_reads import CyclicReads
from dxlwire.exchange.goal_writes import GoalCell, SyncWrite
from dxlwire.exchange.kernel import Answer, Kernel, KernelGoals
from dxlwire.exchange.reports import Reason
from dxlwire.exchange.samples import Samples
from dxlwire.modes import COMMAND_INTERFACES
from dxlwire.plan.device_reads import device_blocks
from dxlwire.plan.line import TIMEOUT_MARGIN_NS
from dxlwire.plan.mode_plan import field
from dxlwire.plan.planning import goal_parts
from dxlwire.plan.reads import choose_reads, read_budget, read_by

_HIGHEST_TICK = (1 << 31) - 1  # Ticks of the kernel have 32 bits


class _Joints(msgspec.Struct):
    """States of joints, of which a script has none; implements `JointArrays`."""

    position: Floats = msgspec.field(default_factory=lambda: np.empty(0))
    velocity: Floats = msgspec.field(default_factory=lambda: np.empty(0))
    effort: Floats = msgspec.field(default_factory=lambda: np.empty(0))
    valid: NDArray[np.bool_] = msgspec.field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    age_ns: NDArray[np.int64] = msgspec.field(default_factory=lambda: np.empty(0, dtype=np.int64))
    mode: NDArray[np.uint8] = msgspec.field(default_factory=lambda: np.empty(0, dtype=np.uint8))


class _NoReports:
    """Report sink of a script, in which every lost value is marked as invalid."""

    def report(self, reason: Reason, source: str, text: str) -> None:
        """Discard a report."""


class _Writes(msgspec.Struct):
    sync_writes: tuple[SyncWrite, ...] = ()


class Reading(ReadRows):
    """The exchange of one reader by the kernel, or by the parser after a deviation from the plan."""

    def __init__(
        self, session: Session, servos: Sequence[Addressed], items: Sequence[str], *, raw: bool
    ) -> None:
        super().__init__(session, servos, items)
        self.session = session
        self._recording = session.log.recording
        plan = _read_plan(session, servos, items, raw)
        self._samples = Samples([plan], _Joints(), self._arrays, _NoReports())
        self.reads = CyclicReads(plan, self._samples.buses[0], session.engine.owed)
        self.kernel = _kernel(session, plan, self._samples, _Writes())
        self.exchange = CyclicExchange(session.lines, [self.reads], self.kernel)
        self.by_kernel = False
        self._members = plan.members
        self._read_by = plan.read_by

    @property
    def read_by(self) -> str:
        """Instructions of one call in the e-Manual's words."""
        return self._read_by

    def read_servos(self) -> None:
        """Read every item of every servo once. Raises PortError if the line is closed or lost."""
        session = self.session
        session.check_open()
        if self.begin_cycle():
            try:
                with session.uninterrupted():
                    session.lines.pump()
            finally:
                self.end_cycle()  # Also after a KeyboardInterrupt
            session.check_open()
        if self._recording is not None:
            self._recording.commit_packets()

    def begin_cycle(self, *, kernel: bool = True) -> bool:
        """Read by the kernel if it can; otherwise load the reads for `Lines.pump`, and return True."""
        if self.reads.stale or not self.by_kernel:
            self.by_kernel = self.exchange.plan_reads() and kernel
        try:
            code = self.kernel.read() if self.by_kernel else Answer.UNEXPECTED
            if not code:
                return False
            answer = self.kernel.finish_read(code)
        except BaseException:  # Ctrl-C: replies to the kernel's request are still on the line
            self.session.is_unfinished = True
            self.exchange.interrupt_kernel()
            self.end_cycle()
            raise
        if answer is Answer.LOOK:
            self._samples.accept_plausible(self.session.lines.clock.now_ns())
        if answer is not Answer.UNEXPECTED:
            return False
        if self.by_kernel:
            self.exchange.interrupt_kernel()
        self.exchange.load_reads()
        return True

    def end_cycle(self) -> None:
        """End a cycle that the parser has read."""
        self.by_kernel = False
        reads = self.reads
        for member in range(len(reads.missed)):
            arrived = self._samples.buses[0].arrived(member)
            reads.missed[member] = 0 if arrived else reads.missed[member] + 1
        # The kernel accepts no other error byte than the one that the parser has read.
        self._alert = np.zeros_like(self._alert)
        for one, error in zip(self._members, reads.errors, strict=True):
            self._alert[one.device] |= bool(error & self._alert_bits)
        reads.end_cycle()
        reads.given_up.clear()
        self._samples.fill_states(self.session.lines.clock.now_ns())


class Writing(WrittenRows):
    """The sync writes of one writer, built by the kernel."""

    def __init__(
        self, session: Session, servos: Sequence[Addressed], items: Sequence[str], *, raw: bool
    ) -> None:
        super().__init__(session, servos, items)
        self._session = session
        self._recording = session.log.recording
        rows = ServoRows(np.empty(0), np.empty(0, np.bool_), np.empty(0, np.int64))
        samples = Samples([session.plan], _Joints(), rows, _NoReports())
        self._writes = _Writes(_sync_writes(session, servos, items, raw))
        self._kernel = _kernel(session, session.plan, samples, self._writes, self._goals)
        self._kernel.plan_writes()

    def send_goals(self) -> None:
        """Send the goals. Raises PortError if the line is closed or lost."""
        session = self._session
        session.check_open()
        if code := self._kernel.write():
            for failure in self._kernel.finish_write(code).values():
                session.engine.mark_lost(failure)
            session.check_open()
        if self._recording is not None:
            self._recording.commit_packets()


def _kernel(
    session: Session, plan: BusPlan, samples: Samples, writes: _Writes, goals: Floats | None = None
) -> Kernel:
    count = 0 if goals is None else goals.shape[1]
    shared = KernelGoals(writes, np.ones(count, np.bool_), np.full(count, np.nan))
    if goals is None:
        goals = np.empty((len(COMMAND_INTERFACES), 0))
    return Kernel(session.lines, [shared], samples, goals, session.log, plans=[plan])


def _read_plan(session: Session, servos: Sequence[Addressed], items: Sequence[str], raw: bool) -> BusPlan:
    """Return the plan by which a reader reads the servos, each as a device."""
    count = len(servos)
    devices = []
    for row, servo in enumerate(servos):
        wanted = {name: _unscaled(item_of(servo.table, name), raw) for name in items}
        columns = range(row, len(items) * count, count)
        blocks = device_blocks(session.line, servo.table, wanted, columns)
        name = f"ID {servo.servo_id}"
        devices.append(DevicePlan(name, servo.servo_id, servo.table.model, None, row, blocks))
    members = members_of((), devices)
    able = [
        servo.table.capabilities for servo, device in zip(servos, devices, strict=True) for _ in device.blocks
    ]
    reads = choose_reads(session.line, members, able, ())
    return msgspec.structs.replace(
        session.plan,
        groups=reads.groups,
        reads=reads.plain,
        budget=read_budget(session.line, reads.chosen, ()),
        fast=reads.fast,
        read_by=read_by(session.plan.protocol, members, reads),
        devices=tuple(devices),
        device_margin_ns=TIMEOUT_MARGIN_NS,
    )


def _unscaled(item: ControlItem, raw: bool) -> ControlItem:
    return msgspec.structs.replace(item, scale=1.0, offset=0.0) if raw else item


def _sync_writes(
    session: Session, servos: Sequence[Addressed], items: Sequence[str], raw: bool
) -> tuple[SyncWrite, ...]:
    """Return the sync writes of these items: one for each block of adjacent items, and for each layout."""
    groups: dict[tuple[GoalLayout, tuple[str, ...]], list[int]] = {}
    for row, servo in enumerate(servos):
        for block in side_by_side(writable_item(servo, name) for name in items):
            length = block[-1].address + block[-1].size - block[0].address
            layout = GoalLayout(block[0].address, length)
            groups.setdefault((layout, tuple(item.name for item in block)), []).append(row)
    return tuple(
        SyncWrite(
            layout,
            0,  # Half of a servo's items would be sent with zeros or old values for the rest
            tuple(part),
            tuple(part),
            tuple(servos[row].servo_id for row in part),
            tuple(
                [_cell(item_of(servos[row].table, name), layout, items.index(name), raw) for name in names]
                for row in part
            ),
            leads=len(items),
            always=True,
        )
        for (layout, names), rows in groups.items()
        for part in goal_parts(session.line.dialect, layout, rows)
    )


def _cell(item: ControlItem, layout: GoalLayout, row: int, raw: bool) -> GoalCell:
    lowest, highest = tick_range(item)
    known = _unscaled(item, raw)
    place = field(item, layout.address)
    return GoalCell(
        place,
        row,
        False,
        1.0,
        -known.offset,
        known.scale,
        max(lowest, -_HIGHEST_TICK),
        min(highest, _HIGHEST_TICK),
    )
