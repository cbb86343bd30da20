"""Recording of a bus: what a host asked on it, and what it heard each time, from a log of dxlrun."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dxlrun.errors import LogError
from dxlrun.log.columns import PacketColumns
from dxlrun.log.reader import open_log
from dxlwire.packets import PacketKind


class Heard(NamedTuple):
    """Bytes that the host received together."""

    delay_ns: int  # From the end of the instruction on the wire to the last of them, as the host saw it
    data: bytes


class Recording:
    """Every instruction of a bus with what was heard after it, in order; each is given once, the last again.

    What was heard before the next instruction belongs to the one before it. Raises LogError.
    """

    def __init__(self, path: Path, bus: str, baud_rate: int) -> None:
        pieces = []
        for piece in open_log(path).slices():
            if bus not in piece.buses:
                raise LogError(f"{path}: the log has no bus {bus}")
            pieces.append(piece.packets.take(piece.packets.bus == piece.buses.index(bus)).compact())
        packets = PacketColumns.joined(pieces)
        packets = packets.take(np.argsort(packets.first_ns, kind="stable")).compact()
        first_ns, last_ns, start, length = packets.first_ns, packets.last_ns, packets.start, packets.length
        data, asked = packets.data.tobytes(), packets.kind == PacketKind.INSTRUCTION
        rows = np.flatnonzero(asked)
        if not len(rows):
            raise LogError(f"{path}: no instruction was sent on bus {bus}, so there is nothing to answer")
        wire_ns = length[rows] * 10_000_000_000 // baud_rate
        behind = np.cumsum(wire_ns)
        # several that were written together pass the wire one after the other
        sent_ns = behind + np.maximum.accumulate(first_ns[rows] - (behind - wire_ns))
        self._data = data
        self._rows = rows
        self._start, self._length = start, length
        self._delay_ns = last_ns - sent_ns[np.maximum(np.cumsum(asked) - 1, 0)]
        self._exchanges: dict[bytes, array[int]] = {}
        for number, (begin, size) in enumerate(zip(start[rows].tolist(), length[rows].tolist(), strict=True)):
            self._exchanges.setdefault(data[begin : begin + size], array("q")).append(number)
        self._next = dict.fromkeys(self._exchanges, 0)

    @property
    def instructions(self) -> Sequence[bytes]:
        """The different instructions."""
        return tuple(self._exchanges)

    def newest(self, instruction: bytes) -> tuple[Heard, ...]:
        """Return what was given last for an instruction, or what will be given first."""
        return self._heard(self._exchanges[instruction][max(0, self._next[instruction] - 1)])

    def take(self, instruction: bytes) -> tuple[Heard, ...] | None:
        """Return what was heard after an instruction the next time; None: it was never sent."""
        exchanges = self._exchanges.get(instruction)
        if exchanges is None:
            return None
        number = self._next[instruction]
        self._next[instruction] = min(number + 1, len(exchanges))
        return self._heard(exchanges[min(number, len(exchanges) - 1)])

    def _heard(self, exchange: int) -> tuple[Heard, ...]:
        first = int(self._rows[exchange]) + 1
        end = int(self._rows[exchange + 1]) if exchange + 1 < len(self._rows) else len(self._start)
        return tuple(
            Heard(delay_ns, self._data[start : start + length])
            for delay_ns, start, length in zip(
                self._delay_ns[first:end].tolist(),
                self._start[first:end].tolist(),
                self._length[first:end].tolist(),
                strict=True,
            )
        )
