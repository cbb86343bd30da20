"""What a host waited for on a simulated bus, and how much of it the simulation is to blame for.

A simulated servo is a process, so it takes an instruction later than a real one would, and hands its reply
over later. That is not the host's fault, and the ledger knows it:

- `in`: when the bytes were taken. When the host wrote them only the host knows, so that part is known of
  hosts that say it. Bytes that had to wait for the line anyway are not late.
- `out`: how long after it had passed the wire a reply was handed over.

Only what a host waits for counts: the last reply of a transaction, and the instruction before it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from dxlrun.simulation import LedgerEntry

Sent = Sequence[tuple[int, int]]
"""When a host began to write, ns, and how many bytes; all that it wrote, in order."""


@dataclass(frozen=True, slots=True)
class Transaction:
    """An instruction that was answered."""

    handed_ns: int
    """When the host was given the end of the last reply."""
    late_ns: int
    """How much sooner that could have been."""
    taken: int
    """Bytes that went to the servos until then, since the ledger began."""
    given: int
    """Bytes that came back."""


def transactions(entries: Sequence[LedgerEntry], sent: Sent, byte_ns: float) -> Iterator[Transaction]:
    """Yield what was answered on one bus; without `sent` only the replies' lateness counts."""
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


def _answered(last: LedgerEntry, waited_ns: float, taken: int, given: int) -> Transaction:
    return Transaction(last.t_ns + last.late_ns, round(last.late_ns + waited_ns), taken, given)


def _written(entries: Sequence[LedgerEntry], sent: Sent) -> dict[int, int]:
    """Return by number of an `in` when the host began to write its first byte; {} when they do not match."""
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
