"""Time that the cycles of a loop waited for late simulated servos, from their ledger.

A simulated servo is a process, so it receives an instruction and delivers its reply later than a real servo.
The ledger records both:

- `in`: time at which the bytes were received. The time at which the host wrote them is only known if the host
  records it. Bytes that had to wait for the line are not late.
- `out`: delay of a reply after it would have passed a real wire.

Only delays for which the host waits count: those of the last reply of a transaction and of the instruction
before it, in the read or in the idle time after the deadline. The host waits for several buses at once, so
the latest one counts.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dxlrun import Log
from dxlrun_analysis.plan_excerpt import LoggedBus, plan_of
from dxlsim import LedgerEntry
from dxlwire import BITS_PER_BYTE, PacketKind

Longs = NDArray[np.int64]
Sent = Sequence[tuple[int, int]]
"""Start time (ns) and length (bytes) of each instruction that the host wrote to a bus, from the log"""


class LedgerTransaction(NamedTuple):
    """Instruction and its replies on a simulated bus, from the ledger"""

    handed_ns: int  # time at which the end of the last reply was delivered to the host
    late_ns: int  # delay of that delivery
    taken: int  # bytes to the servos so far, since the start of the ledger
    given: int  # bytes from the servos so far


def waits_for_servos(log: Log, entries: Iterable[LedgerEntry]) -> tuple[Longs, Longs]:
    """Return how long each cycle waited for late simulated servos, ns, as two arrays of shape (cycles,).

    The first is the wait in the cycle's read, the second the wait between its deadline and its wake-up.
    """
    by_bus: dict[str, list[LedgerEntry]] = {name: [] for name in log.buses}
    for entry in entries:
        by_bus.setdefault(entry.bus, []).append(entry)
    in_read, in_idle = np.zeros(len(log.cycles), np.int64), np.zeros(len(log.cycles), np.int64)
    for index, name in enumerate(log.buses):
        packets = sorted((p for p in log.packets if p.bus == index), key=lambda packet: packet.first_ns)
        sent = [(p.first_ns, len(p.data)) for p in packets if p.kind is PacketKind.INSTRUCTION]
        rate = plan_of(log).by_name.get(name, LoggedBus()).baud_rate
        byte_ns = BITS_PER_BYTE * 1e9 / rate if rate else 0.0
        read, idle = _waits(log.cycles, transactions(by_bus[name], sent, byte_ns))
        in_read, in_idle = np.maximum(in_read, read), np.maximum(in_idle, idle)
    return in_read, in_idle


def _waits(cycles: NDArray[np.void], found: Iterable[LedgerTransaction]) -> tuple[Longs, Longs]:
    """Return the two arrays of `waits_for_servos` for one bus."""
    scheduled, woken = cycles["scheduled_ns"], cycles["woken_ns"]
    in_read, in_idle = np.zeros(len(woken), np.int64), np.zeros(len(woken), np.int64)
    for one in found:
        index = int(np.searchsorted(woken, one.handed_ns, side="right")) - 1
        if index >= 0 and one.handed_ns <= cycles["read_ns"][index]:
            # Only count the wait since the wake-up, because the request may be of the cycle before.
            in_read[index] += min(one.late_ns, one.handed_ns - int(woken[index]))
        elif index + 1 < len(woken) and one.handed_ns > scheduled[index + 1]:
            waited = min(one.late_ns, one.handed_ns - int(scheduled[index + 1]))
            in_idle[index + 1] = max(in_idle[index + 1], waited)
    return in_read, in_idle


def overruns_by_servos(log: Log, entries: Iterable[LedgerEntry]) -> int:
    """Return the number of cycles that skipped periods only because simulated servos were late."""
    cycles = log.cycles
    in_read, in_idle = waits_for_servos(log, entries)
    took_ns = cycles["written_ns"] - cycles["scheduled_ns"] - in_read - in_idle
    skipped_behind = cycles["skipped"][1:] > 0
    return int(np.count_nonzero(skipped_behind & (took_ns[:-1] <= log.period_ns)))


def transactions(entries: Sequence[LedgerEntry], sent: Sent, byte_ns: float) -> Iterator[LedgerTransaction]:
    """Yield the transactions of one simulated bus from the entries of its ledger, with their delays.

    `byte_ns` is the duration of a byte on the wire. Without `sent`, only the delays of replies count.
    """
    written = _written(entries, sent)
    free_ns = could_be_free_ns = waited_ns = 0.0
    taken = given = 0
    last: LedgerEntry | None = None
    for number, entry in enumerate(entries):
        if entry.direction == "out":
            last = entry
            given += len(entry.data)
        elif entry.direction == "in":
            if last is not None:
                yield _answered(last, waited_ns, taken, given)
                last = None
            wire_ns = len(entry.data) * byte_ns
            could = max(min(written.get(number, entry.t_ns), entry.t_ns), could_be_free_ns)
            began = max(entry.t_ns, free_ns)
            waited_ns = began - could
            could_be_free_ns, free_ns = could + wire_ns, began + wire_ns
            taken += len(entry.data)
    if last is not None:
        yield _answered(last, waited_ns, taken, given)


def _answered(last: LedgerEntry, waited_ns: float, taken: int, given: int) -> LedgerTransaction:
    return LedgerTransaction(last.t_ns + last.late_ns, round(last.late_ns + waited_ns), taken, given)


def _written(entries: Sequence[LedgerEntry], sent: Sent) -> dict[int, int]:
    """Return the time, ns, at which the host wrote the first byte of each `in` entry, by the entry's index.
    Empty if the entries have more bytes than the host wrote."""
    ends = np.cumsum([count for _, count in sent])
    taken = sum(len(entry.data) for entry in entries if entry.direction == "in")
    if not len(ends) or taken > ends[-1]:
        return {}
    found: dict[int, int] = {}
    offset = 0
    for number, entry in enumerate(entries):
        if entry.direction == "in":
            found[number] = sent[int(np.searchsorted(ends, offset, side="right"))][0]
            offset += len(entry.data)
    return found
