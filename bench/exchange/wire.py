"""A measurement in the simulated bus' ledger: bytes on the wire, and the servos' own lateness."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dxlrun_lab.late_servos import LedgerTransaction


@dataclass(frozen=True, slots=True)
class Judged:
    """The exchanges of a host, in the ledger."""

    late_ns: NDArray[np.int64]
    """Of each, how much sooner its transactions could have ended."""
    sent_bytes: float
    """Bytes that go to the servos, an exchange."""
    received_bytes: float


def judge(
    found: Iterable[LedgerTransaction], starts_ns: NDArray[np.int64], walls_ns: NDArray[np.int64]
) -> Judged:
    """Put transactions to the exchanges, by when these began and how long they took, in order.

    Between the first transaction of one exchange and that of the next, the bytes of one exchange pass, also
    when the servos take its last ones after the host has gone on.
    """
    late = np.zeros(len(starts_ns), np.int64)
    first: dict[int, LedgerTransaction] = {}
    for one in found:
        index = int(np.searchsorted(starts_ns, one.handed_ns, side="right")) - 1
        if index >= 0 and one.handed_ns <= starts_ns[index] + walls_ns[index]:
            late[index] += one.late_ns
            first.setdefault(index, one)
    follow = [
        (first[index], first[index + 1])
        for index in range(len(starts_ns) - 1)
        if index in first
        and index + 1 in first
        and starts_ns[index] + walls_ns[index] == starts_ns[index + 1]
    ]
    if not follow:
        return Judged(late, float("nan"), float("nan"))
    return Judged(
        late,
        sum(after.taken - before.taken for before, after in follow) / len(follow),
        sum(after.given - before.given for before, after in follow) / len(follow),
    )
