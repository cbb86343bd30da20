"""Recording of a bus: what a host asked on it, and what it heard each time."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlwire.errors import InputError


class RecordedPackets(msgspec.Struct, frozen=True):
    """Packets that passed one bus, in any order: one row each. Times are ns of one clock."""

    is_instruction: NDArray[np.bool_]  # True: the host sent it; False: the host received it
    first_ns: NDArray[np.int64]  # Before the write that sent it; after the read that brought its first byte
    last_ns: NDArray[np.int64]  # After the write; after the read that brought its last byte
    start: NDArray[np.int64]  # Index in `data` of its first byte
    length: NDArray[np.int64]  # Bytes
    data: bytes  # Of all packets, and possibly of others


class Heard(NamedTuple):
    """Bytes that the host received together."""

    delay_ns: int  # From the end of the instruction on the wire to the last of them, as the host saw it
    data: bytes


class Recording:
    """Every instruction of a bus with what was heard after it, in order; each is given once, the last again.

    What was heard before the next instruction belongs to the one before it. Raises InputError where there is
    no instruction.
    """

    def __init__(self, packets: RecordedPackets, baud_rate: int) -> None:
        order = np.argsort(packets.first_ns, kind="stable")
        first_ns, last_ns = packets.first_ns[order], packets.last_ns[order]
        start, length = packets.start[order], packets.length[order]
        data, asked = packets.data, packets.is_instruction[order]
        rows = np.flatnonzero(asked)
        if not len(rows):
            raise InputError("no instruction was sent on the recorded bus, so there is nothing to answer")
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
