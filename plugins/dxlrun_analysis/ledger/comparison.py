"""Comparison of a log with the ledger of the simulated buses that it ran on.

The ledger is the judge: the runtime cannot edit it. Compared is the time of the run; what other programs did
on the buses before and after is only counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from dxlrun.channels.events import Event, EventCode, LostRecords
from dxlrun.channels.packets import LoggedPacket, PacketKind
from dxlrun.errors import InputError, counted
from dxlrun.log.reader import UNREADABLE, Log
from dxlrun.output.table import Cell, Column, Part, Sentence, Table, Value, flagged, microseconds, numbers
from dxlrun.simulation import LedgerEntry
from dxlrun_analysis.ledger.faults import FaultAnswers, UncausedEvent, answered, uncaused
from dxlrun_analysis.ledger.overruns import Lateness, OverrunCauses, lateness, overrun_causes
from dxlrun_analysis.ledger.streams import WAYS, ByteStream, Span, Way, differing, logged, seen
from dxlrun_analysis.report import once
from dxlrun_analysis.servos.traffic import joints_of

GRACE_NS = 250_000_000
"""What the bus sees so long after the log's last record still belongs to the run; the next run takes longer
to start."""
_MOST_SHOWN = 20
"""Differences and faults in a table; `--json` has all."""
_MOST_BYTES = 16
RING_NS = 20_000_000_000
"""A recorder that lost records lost them at most so long before its event: twice what a ring holds."""


@dataclass(frozen=True, slots=True)
class StreamDifference:
    """Bytes that are in one record of a bus and not in the other."""

    seconds: float
    """Since the log's first packet."""
    bus: str
    way: Way
    only_log: bytes
    only_ledger: bytes
    declared: str = ""
    """How the log itself explains what it lacks; empty: nothing explains it."""


@dataclass(frozen=True, slots=True)
class ComparedBus:
    """One bus over the time of the run."""

    name: str
    sent_packets: int
    sent_bytes: int
    """By the log, as all that follow but the last."""
    replies: int
    received_bytes: int
    noise_bytes: int
    differences: int
    """Without those that the log declares."""
    declared: int
    outside_bytes: int
    """Bytes in the ledger before and after the run."""


@dataclass(frozen=True, slots=True)
class LedgerReport:
    """All results of `dxlrun analyze LOG --ledger LEDGER`."""

    log: str
    ledger: str
    same: bool
    """No difference but declared ones."""
    good: bool
    """The same, and each fault was noticed that no run bears in silence, and each event has a cause."""
    sentences: tuple[str, ...]
    buses: tuple[ComparedBus, ...]
    differences: tuple[StreamDifference, ...]
    """In order of time."""
    faults: tuple[FaultAnswers, ...]
    """What was injected during the run."""
    uncaused: tuple[UncausedEvent, ...]
    """Events that report a fault where the ledger has none."""
    lateness: Lateness | None
    """None where no servo sent anything."""
    causes: OverrunCauses | None
    """Why the loop overran; None where it had no cycle."""


def compare(log: Log, entries: Sequence[LedgerEntry], ledger: Path) -> LedgerReport:
    """Compare a log with a ledger, bus by bus; `ledger` is only named.

    Raises InputError when the two cannot be of one run, LogError when a packet cannot be read.
    """
    if not log.packets:
        raise InputError(f"{log.path} holds no packet, so there is nothing to compare with a ledger")
    begin_ns = min(packet.first_ns for packet in log.packets)
    end_ns = max(last_of(log), *(packet.last_ns for packet in log.packets)) + GRACE_NS
    by_bus = _by_bus(log, entries, ledger)
    of_run = [entry for one in by_bus.values() for entry in one if begin_ns <= entry.t_ns <= end_ns]
    if not any(entry.data for entry in of_run):
        raise InputError(
            f"{ledger} holds not a byte from the time of {log.path}: the two are of different runs; "
            "a ledger is only good for the runs that used its simulated buses"
        )
    buses: list[ComparedBus] = []
    differences: list[StreamDifference] = []
    for index, name in enumerate(log.buses):
        packets = sorted((p for p in log.packets if p.bus == index), key=lambda packet: packet.first_ns)
        found = _differences(log, packets, by_bus[name], (begin_ns, end_ns))
        outside = sum(len(e.data) for e in by_bus[name] if not begin_ns <= e.t_ns <= end_ns)
        buses.append(_bus(name, packets, found, outside))
        differences += found
    joints = joints_of(log)
    faults = answered(of_run, log.events, joints, begin_ns, log.period_ns)
    causeless = uncaused(of_run, log.events, joints, begin_ns)
    late = lateness(log, of_run)
    causes = overrun_causes(log, by_bus)
    same = not any(bus.differences for bus in buses)
    return LedgerReport(
        log=str(log.path),
        ledger=str(ledger),
        same=same,
        good=same and not causeless and not any(fault.unanswered for fault in faults),
        sentences=(
            *_sentences(buses),
            *_fault_sentences(faults, causeless),
            *_overrun_sentences(late, causes),
        ),
        buses=tuple(buses),
        differences=tuple(sorted(differences, key=lambda difference: difference.seconds)),
        faults=faults,
        uncaused=causeless,
        lateness=late,
        causes=causes,
    )


def last_of(log: Log) -> int:
    """Return the time of the last cycle and event in a log, ns; 0 where it has neither."""
    times = [event.t_ns for event in log.events]
    if len(log.cycles):
        times.append(int(log.cycles["written_ns"][-1]))
    return max(times, default=0)


def _by_bus(log: Log, entries: Sequence[LedgerEntry], ledger: Path) -> dict[str, list[LedgerEntry]]:
    """Return the entries by the log's names of the buses; one bus alone may have another name."""
    found: dict[str, list[LedgerEntry]] = {}
    for entry in entries:
        found.setdefault(entry.bus, []).append(entry)
    if len(found) == 1 and len(log.buses) == 1:
        name = log.buses[0]
        return {name: [entry._replace(bus=name) for entry in next(iter(found.values()))]}
    missing = [name for name in log.buses if name not in found]
    if missing:
        known = ", ".join(sorted(found))
        raise InputError(
            f"{ledger} knows no bus {', '.join(missing)}{f', only {known}' if known else ''}; "
            f"give the ledger of the simulated buses on which {log.path} was made"
        )
    return found


def _differences(
    log: Log, packets: Sequence[LoggedPacket], entries: Sequence[LedgerEntry], run: tuple[int, int]
) -> list[StreamDifference]:
    """Return how the log and the ledger of one bus differ during the run."""
    found: list[StreamDifference] = []
    begin_ns = min((packet.first_ns for packet in log.packets), default=0)
    looked_ns = max((packet.last_ns for packet in packets), default=run[0])
    name = log.buses[packets[0].bus] if packets else (entries[0].bus if entries else "")
    for way in WAYS:
        mine, theirs = logged(packets, way), seen(entries, way).between(*run)
        for span in differing(mine, theirs):
            t_ns = _when(span, mine, theirs)
            trailing = span.log_start == span.log_stop == len(mine.data)
            unread = way == "received" and trailing and t_ns >= looked_ns
            late = "came after the host had read for the last time" if unread else ""
            found.append(
                StreamDifference(
                    seconds=(t_ns - begin_ns) / 1e9,
                    bus=name,
                    way=way,
                    only_log=mine.data[span.log_start : span.log_stop],
                    only_ledger=theirs.data[span.ledger_start : span.ledger_stop],
                    declared=_declared(log, span, t_ns) or late,
                )
            )
    return found


def _when(span: Span, mine: ByteStream, theirs: ByteStream) -> int:
    in_ledger = span.ledger_stop > span.ledger_start
    return theirs.time_at(span.ledger_start) if in_ledger else mine.time_at(span.log_start)


def _declared(log: Log, span: Span, t_ns: int) -> str:
    """Return how the log itself explains that it lacks these bytes; empty when it does not."""
    if span.log_stop > span.log_start:
        return ""
    if log.damage:
        return f"the log says: {log.damage[0]}"
    for event in log.events:
        if _of_packets(event) and -GRACE_NS <= event.t_ns - t_ns + GRACE_NS <= RING_NS:
            return f"the log says: {event.text}"
    return ""


def _of_packets(event: Event) -> bool:
    """Return whether an event declares that packets did not reach the log."""
    if event.code != EventCode.RECORDER_GAP:
        return False
    try:
        return msgspec.json.decode(event.data, type=LostRecords).ring.endswith("packets")
    except UNREADABLE:
        return False


def _bus(
    name: str, packets: Sequence[LoggedPacket], found: Sequence[StreamDifference], outside: int
) -> ComparedBus:
    size = dict.fromkeys(PacketKind, 0)
    number = dict.fromkeys(PacketKind, 0)
    for packet in packets:
        size[packet.kind] += len(packet.data)
        number[packet.kind] += 1
    declared = sum(1 for difference in found if difference.declared)
    return ComparedBus(
        name=name,
        sent_packets=number[PacketKind.INSTRUCTION],
        sent_bytes=size[PacketKind.INSTRUCTION],
        replies=number[PacketKind.STATUS],
        received_bytes=sum(size.values()) - size[PacketKind.INSTRUCTION],
        noise_bytes=size[PacketKind.NOISE],
        differences=len(found) - declared,
        declared=declared,
        outside_bytes=outside,
    )


def _sentences(buses: Sequence[ComparedBus]) -> list[str]:
    bad = [bus for bus in buses if bus.differences]
    sentences: list[str] = []
    if bad:
        where = ", ".join(f"{counted(bus.differences, 'place', 'places')} on {bus.name}" for bus in bad)
        sentences.append(f"The log is not what the simulated buses saw: it differs in {where}.")
    else:
        sent = counted(sum(bus.sent_packets for bus in buses), "packet", "packets")
        got = counted(sum(bus.replies for bus in buses), "reply", "replies")
        lines = "the bus" if len(buses) == 1 else f"all {len(buses)} buses"
        sentences.append(f"The log is what {lines} saw, to the byte: {sent} out, {got} in.")
    declared = sum(bus.declared for bus in buses)
    if declared:
        sentences.append(f"The log itself explains {counted(declared, 'difference', 'differences')}.")
    return sentences


def _fault_sentences(faults: Sequence[FaultAnswers], causeless: Sequence[UncausedEvent]) -> list[str]:
    sentences: list[str] = []
    if faults:
        silent = sum(1 for fault in faults if not fault.answers)
        borne = f"; the log has no answer to {silent} of them" if silent else "; the log answers each"
        were = "fault was" if len(faults) == 1 else "faults were"
        sentences.append(f"{len(faults)} {were} injected{borne}.")
    unnoticed = [fault for fault in faults if fault.unanswered]
    if unnoticed:
        first = unnoticed[0]
        what = (
            "1 fault that had to be noticed was not"
            if len(unnoticed) == 1
            else (f"{len(unnoticed)} faults that had to be noticed were not")
        )
        sentences.append(f"{what}: {first.text}, by no event of {', '.join(first.unanswered)} within 2 s.")
    if causeless:
        first_event = causeless[0]
        what = "1 event has" if len(causeless) == 1 else f"{len(causeless)} events have"
        sentences.append(
            f"{what} no cause in the ledger; the first: {first_event.name} of {first_event.source}."
        )
    return sentences


def _overrun_sentences(late: Lateness | None, causes: OverrunCauses | None) -> list[str]:
    """Return what a person must know of the simulation before they blame the loop."""
    if late is None or not late.overruns:
        return []
    overran = f"The loop overran {counted(late.overruns, 'time', 'times')}"
    beside = "never" if not late.overruns_beside else counted(late.overruns_beside, "time", "times")
    sentences = [f"{overran}, {beside} with a simulated reply that was more than 1 ms late."]
    if causes is not None and causes.overruns:
        sentences.append(
            f"The cause was the simulated servos {counted(causes.simulation, 'time', 'times')}, the kernel "
            f"{counted(causes.kernel, 'time', 'times')}, which hands replies over, a late wake-up "
            f"{counted(causes.wake_up, 'time', 'times')}, and our own work "
            f"{counted(causes.own_work, 'time', 'times')}: {causes.own_share:.3%} of {causes.cycles} cycles."
        )
    return sentences


# The comparison as tables


def parts(report: LedgerReport) -> tuple[Part, ...]:
    """Return what a terminal shows: sentences, then one table a subject that has rows."""
    first, *others = report.sentences
    return (
        Sentence(first, "good" if report.good else "error"),
        *others,
        _buses_table(report.buses),
        _differences_table(report.differences),
        _faults_table(report.faults),
        _uncaused_table(report.uncaused),
        *(
            []
            if report.lateness is None or not report.lateness.max_us
            else [_lateness_table(report.lateness)]
        ),
        *([] if report.causes is None else [_overruns_table(report.causes)]),
    )


def _buses_table(buses: Sequence[ComparedBus]) -> Table:
    columns = [
        Column("bus", "name"),
        *numbers("sent", "bytes", "replies", "bytes", "noise", "differences", "declared"),
        Column("outside the run", form="{} B"),
    ]
    rows = [
        (
            bus.name,
            bus.sent_packets,
            bus.sent_bytes,
            bus.replies,
            bus.received_bytes,
            flagged(bus.noise_bytes, f"{bus.noise_bytes} B"),
            flagged(bus.differences, tone="error"),
            flagged(bus.declared),
            bus.outside_bytes,
        )
        for bus in buses
    ]
    return Table.of("Buses", columns, rows)


def _differences_table(differences: Sequence[StreamDifference]) -> Table:
    columns = [
        Column("at, s", form="{:.6f}"),
        Column("bus", "name"),
        Column("host", "name"),
        Column("only in the log", "text"),
        Column("only in the ledger", "text"),
        Column("declared", "text"),
    ]
    rows = [
        (
            one.seconds,
            one.bus,
            one.way,
            Cell(_bytes(one.only_log), "plain" if one.declared else "error"),
            Cell(_bytes(one.only_ledger), "plain" if one.declared else "error"),
            one.declared or "-",
        )
        for one in differences[:_MOST_SHOWN]
    ]
    return Table.of(_title("Differences", len(differences)), columns, rows)


def _faults_table(faults: Sequence[FaultAnswers]) -> Table:
    """Return the injected faults, each beside the first event that may answer it."""
    columns = [
        Column("at, s", form="{:.6f}"),
        Column("bus", "name"),
        Column("fault", "text"),
        Column("after"),
        Column("event of the log", "text"),
    ]
    rows = []
    for fault in faults[:_MOST_SHOWN]:
        first = fault.answers[0] if fault.answers else None
        event = Cell(f"{first.name}: {once(f'{first.source}: {first.text}')}" if first else "none within 2 s")
        if fault.unanswered:
            event = Cell(f"none of {', '.join(fault.unanswered)} within 2 s", "error")
        after = microseconds(first.after_ms * 1000) if first else "-"
        rows.append((fault.seconds, fault.bus, fault.text, after, event))
    return Table.of(_title("Injected faults", len(faults)), columns, rows)


def _uncaused_table(events: Sequence[UncausedEvent]) -> Table:
    columns = [Column("at, s", form="{:.6f}"), Column("event", "name"), Column("text", "text")]
    rows = [
        (one.seconds, Cell(one.name, "error"), once(f"{one.source}: {one.text}"))
        for one in events[:_MOST_SHOWN]
    ]
    return Table.of(_title("Events without a cause", len(events)), columns, rows)


def _lateness_table(late: Lateness) -> Table:
    rows: list[tuple[Value, ...]] = [
        ("deliveries", late.deliveries),
        ("late, median", microseconds(late.median_us)),
        ("  99 %", microseconds(late.p99_us)),
        ("  maximum", microseconds(late.max_us)),
        ("later than 1 ms", late.rough),
        ("overruns of the loop", late.overruns),
        ("  beside one later than 1 ms", late.overruns_beside),
    ]
    return Table.of("How late the simulated buses were", [Column("simulation", "name"), Column("")], rows)


def _overruns_table(causes: OverrunCauses) -> Table:
    """Return the worst overruns, each split into what was late."""
    columns = [
        Column("at, s", form="{:.6f}"),
        Column("cause", "name"),
        *numbers(
            "periods left out",
            "late servos",
            "kept by the kernel",
            "late wake-up",
            "own work beyond the usual",
        ),
    ]
    worst = sorted(
        causes.overruns,
        key=lambda one: one.simulation_us + one.kernel_us + one.wake_up_us + one.own_us,
        reverse=True,
    )
    rows: list[tuple[Value, ...]] = [
        (
            one.seconds,
            Cell(one.cause, "warning" if one.cause == "own work" else "plain"),
            one.skipped,
            *map(microseconds, (one.simulation_us, one.kernel_us, one.wake_up_us, max(0.0, one.own_us))),
        )
        for one in worst[:_MOST_SHOWN]
    ]
    title = f"Why the loop overran; a cycle usually takes {microseconds(causes.usual_us)}"
    more = "" if len(worst) <= _MOST_SHOWN else f"; the worst {_MOST_SHOWN} of {len(worst)}, --json has all"
    return Table.of(title + more, columns, rows)


def _title(what: str, number: int) -> str:
    return what if number <= _MOST_SHOWN else f"{what}: the first {_MOST_SHOWN} of {number}; --json has all"


def _bytes(data: bytes) -> str:
    if not data:
        return "-"
    more = f" ... {len(data)} bytes" if len(data) > _MOST_BYTES else ""
    return data[:_MOST_BYTES].hex(" ") + more
