"""Tables of the causes of late and long cycles, and of the packets of the worst cycles."""

from __future__ import annotations

from collections.abc import Iterable

from dxlrun.tooling.output import Column, Table, Value, counted, microseconds
from dxlrun_analysis.causes.causes import KEPT, Causes
from dxlrun_analysis.cycles.worst_cycles import WorstCycle

_MOST_CAUSES = 12
_MOST_NAMED = 3
_BROADCAST_ID = 0xFE


def causes_table(causes: Causes) -> Table:
    """Return the table of the causes of late and long cycles, the largest first; it may have no rows."""
    columns = [
        Column("cause", "name"),
        Column("of", "text"),
        Column("cycles"),
        Column("together"),
        Column("share", form="{:.1%}"),
        Column("worst"),
    ]
    total = max(causes.excess_ns, 1)
    rows = [
        (
            one.kind,
            one.subject or "-",
            one.cycles,
            microseconds(one.total_ns / 1e3),
            one.total_ns / total,
            microseconds(one.worst_ns / 1e3),
        )
        for one in causes.causes[:_MOST_CAUSES]
    ]
    late, long = (counted(number, "cycle", "cycles") for number in (causes.late, causes.long))
    title = (
        f"Causes: {late} woke late, {long} took too long; total excess {microseconds(causes.excess_ns / 1e3)}"
    )
    title += f" in the {KEPT} worst cycles" if max(causes.late, causes.long) > KEPT else ""
    return Table.from_rows(title, columns, rows)


def worst_tables(worst: Iterable[WorstCycle]) -> tuple[Table, ...]:
    """Return one table for each of the worst cycles: its steps and packets in order of time, in us since
    its deadline, with their planned times."""
    return tuple(_timeline(one) for one in worst)


def _timeline(one: WorstCycle) -> Table:
    columns = [
        Column("us", form="{:.0f}"),
        Column("what", "name"),
        Column("of", "text"),
        Column("planned", form="{:.0f}", missing="-"),
        Column("later", form="{:.0f}", missing="-"),
    ]
    rows: list[tuple[float, int, tuple[Value, ...]]] = [
        (us, order, (us, what, "", None, None))
        for order, (us, what) in enumerate(
            (
                (one.woken_us, "woken"),
                (one.read_us, "read"),
                (one.updated_us, "updated"),
                (one.written_us, "written"),
            )
        )
    ]
    for packet in one.packets:
        servo = f"servo {packet.servo_id}" if packet.servo_id != _BROADCAST_ID else "all servos"
        subject = f"{packet.bus}, {packet.joint or servo}"
        planned = packet.planned_us
        later = None if planned is None or packet.kind == "instruction" else packet.end_us - planned
        us = packet.begin_us if packet.kind == "instruction" else packet.end_us
        rows.append((us, -1, (us, packet.kind, subject, planned, later)))
    return Table.from_rows(
        worst_title(one), columns, (row for _, _, row in sorted(rows, key=lambda row: row[:2]))
    )


def worst_title(one: WorstCycle) -> str:
    """Return the title of a cycle's table: number, time, excess beyond the plan, main causes."""
    causes = ", ".join(f"{share.label} {microseconds(share.us)}" for share in one.causes[:_MOST_NAMED])
    skipped = f", then {counted(one.skipped, 'period', 'periods')} skipped" if one.skipped else ""
    beyond = f"{microseconds(one.excess_us)} beyond the plan{skipped}"
    return f"Cycle {one.cycle}, {one.seconds:.3f} s, {beyond}: {causes}"
