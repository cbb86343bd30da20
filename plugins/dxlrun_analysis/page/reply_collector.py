"""Curves of the reply times and lost replies of each servo over a run, collected slice by slice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dxlrun_analysis.page.envelope import Envelope
from dxlrun_analysis.page.run_curves import Curves
from dxlrun_analysis.plan_excerpt import LoggedBus
from dxlrun_analysis.servos.exchanges import Exchanges
from dxlrun_analysis.servos.logged_requests import IDS

# Size in a page before conversion to text: 4 bytes a number, two numbers per row and curve.
BYTES_OF_REPLIES = 1_000_000
_FEWEST_ROWS, _MOST_ROWS = 50, 1500
_BYTES_A_VALUE = 8  # Smallest and largest value, float32 each
_BIN_NS = 1_000_000  # Initial width of a bin


class ReplyCollector:
    """Accumulator of replies as curves: `reply BUS ID`, reply time in us; `lost BUS ID`, 1 for a lost one."""

    def __init__(self) -> None:
        self._columns = np.zeros(0, np.int64)
        """Column of the curves of each servo, by bus and ID; -1: not in the plan."""
        self._names: tuple[str, ...] = ()
        self._envelope = Envelope(0, 2, 1)

    def add_exchanges(self, exchanges: Exchanges) -> None:
        """Add the replies of the next exchanges."""
        if not len(self._columns):
            self._set_up_servos(exchanges.buses)
        count, due = len(self._names), exchanges.due
        values = np.full((len(exchanges.bus), 2 * count), np.nan, np.float32)
        column = self._columns[due.servo]
        came = np.flatnonzero((due.reply >= 0) & (column >= 0))
        of = due.exchange[came]
        took_ns = exchanges.replies.last_ns[due.reply[came]] - exchanges.asked_ns[of]
        values[of, column[came]] = took_ns / 1e3
        lost = np.flatnonzero((due.reply < 0) & (column >= 0) & exchanges.ended[due.exchange])
        values[due.exchange[lost], count + column[lost]] = 1
        # Skip exchanges without replies: the first of each bus has no instruction, and many instructions
        # request nothing.
        rows = np.flatnonzero(np.isfinite(values).any(axis=1))
        rows = rows[np.argsort(exchanges.asked_ns[rows], kind="stable")]
        self._envelope.add_samples(exchanges.asked_ns[rows], values[rows])

    def _set_up_servos(self, buses: Sequence[LoggedBus]) -> None:
        servos = {
            index * IDS + servo_id: f"{bus.name} {servo_id}"
            for index, bus in enumerate(buses)
            for servo_id in bus.names
            if 0 <= servo_id < IDS
        }
        self._columns = np.full(len(buses) * IDS, -1, np.int64)
        self._columns[list(servos)] = np.arange(len(servos))
        self._names = tuple(servos.values())
        self._envelope = Envelope(2 * len(servos), rows_of_replies(len(servos)), _BIN_NS)

    def build_curves(self) -> Curves:
        """Return the curves of all servos and devices of the log's plan."""
        names = tuple(f"{kind} {name}" for kind in ("reply", "lost") for name in self._names)
        return Curves.from_rows(self._envelope.rows(), names)


def rows_of_replies(servos: int) -> int:
    """Return the number of time bins that the reply curves of this many servos may have."""
    return min(max(BYTES_OF_REPLIES // (2 * _BYTES_A_VALUE * max(servos, 1)), _FEWEST_ROWS), _MOST_ROWS)
