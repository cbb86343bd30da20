"""How soon each servo replied over a run, and when it did not, taken slice by slice of a log."""

from __future__ import annotations

import numpy as np

from dxlrun.log.reader import Log
from dxlrun_analysis.page.curves import Curves
from dxlrun_analysis.page.envelope import Envelope
from dxlrun_analysis.servos.exchanges import Exchanges, Pairing

BYTES_OF_REPLIES = 1_000_000
"""In a page, before they are text: 4 bytes a number, two numbers a row and curve."""
_FEWEST_ROWS, _MOST_ROWS = 50, 1500
_BYTES_A_VALUE = 8
_BIN_NS = 1_000_000
"""Of a bin at first."""
_IDS = 256


class ReplyCollector:
    """Takes the packets of a log: its curves are `reply BUS ID`, us, and `lost BUS ID`, 1 where one is."""

    def __init__(self) -> None:
        self._pairing = Pairing()
        self._rows = np.zeros((0, _IDS), np.int64)
        """Number of each servo of the plan by bus and ID, -1: none; shape (buses, IDs)."""
        self._names: tuple[str, ...] = ()
        self._envelope = Envelope(0, 2, 1)

    def take(self, log: Log) -> None:
        """Take the next slice. Raises LogError when a packet in it cannot be read."""
        self._add(self._pairing.take(log))

    def finish(self) -> Curves:
        """Return the curves of all servos of the log's plan."""
        self._add(self._pairing.finish())
        names = tuple(f"{kind} {name}" for kind in ("reply", "lost") for name in self._names)
        return Curves.of(self._envelope.rows(), names)

    def _begin(self) -> None:
        buses = self._pairing.buses
        self._rows = np.full((len(buses), _IDS), -1, np.int64)
        names: list[str] = []
        for index, bus in enumerate(buses):
            for servo_id in bus.names:
                if 0 <= servo_id < _IDS:
                    self._rows[index, servo_id] = len(names)
                    names.append(f"{bus.name} {servo_id}")
        self._names = tuple(names)
        self._envelope = Envelope(2 * len(names), rows_of_replies(len(names)), _BIN_NS)

    def _add(self, exchanges: Exchanges | None) -> None:
        if exchanges is None:
            return
        if not len(self._rows):
            self._begin()
        count, due = len(self._names), exchanges.due
        values = np.full((len(exchanges.bus), 2 * count), np.nan, np.float32)
        column = self._rows.reshape(-1)[due.servo]
        came = np.flatnonzero((due.reply >= 0) & (column >= 0))
        of = due.exchange[came]
        took_ns = exchanges.replies.last_ns[due.reply[came]] - exchanges.asked_ns[of]
        values[of, column[came]] = took_ns / 1e3
        lost = np.flatnonzero((due.reply < 0) & (column >= 0) & exchanges.ended[due.exchange])
        values[due.exchange[lost], count + column[lost]] = 1
        # the first exchange of each bus has no instruction, and many instructions ask nothing
        rows = np.flatnonzero(np.isfinite(values).any(axis=1))
        rows = rows[np.argsort(exchanges.asked_ns[rows], kind="stable")]
        self._envelope.take(exchanges.asked_ns[rows], values[rows])


def rows_of_replies(servos: int) -> int:
    """Return how many bins the curves of so many servos may have."""
    return min(max(BYTES_OF_REPLIES // (2 * _BYTES_A_VALUE * max(servos, 1)), _FEWEST_ROWS), _MOST_ROWS)
