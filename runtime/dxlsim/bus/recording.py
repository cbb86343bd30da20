"""Recording of a bus: the instructions that a host sent, and the answers that it received."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlwire.exceptions import InputError


class RecordedPackets(msgspec.Struct, frozen=True):
    """Packets that passed one recorded bus, one row each, in any order. Times are ns of one clock."""

    is_instruction: NDArray[np.bool_]  # True: sent by the host; False: received by the host
    first_ns: NDArray[np.int64]  # Before the write() of the packet, or after the read() of its first byte
    last_ns: NDArray[np.int64]  # After the write(), or after the read() of its last byte
    start: NDArray[np.int64]  # Index of its first byte in `data`
    length: NDArray[np.int64]  # Bytes
    data: bytes  # Bytes of all packets, possibly with others between them


class RecordedReply(NamedTuple):
    """One packet of a recorded answer, and its delay after the instruction."""

    delay_ns: int  # From the end of the instruction on the wire to the last byte's arrival at the host
    data: bytes


class BusRecording:
    """Instructions of a recorded bus, with the bytes that the host received after each.

    `replay_answer` returns the recorded answers of an instruction one after the other, and then repeats the
    last one. Bytes belong to the instruction before them.

    Raises:
        InputError: The packets contain no instruction.
    """

    def __init__(self, packets: RecordedPackets, baud_rate: int) -> None:
        order = np.argsort(packets.first_ns, kind="stable")
        first_ns, last_ns = packets.first_ns[order], packets.last_ns[order]
        start, length = packets.start[order], packets.length[order]
        data, asked = packets.data, packets.is_instruction[order]
        rows = np.flatnonzero(asked)
        if not len(rows):
            raise InputError("the recorded bus has no instructions; use another log")
        wire_ns = length[rows] * 10_000_000_000 // baud_rate
        behind = np.cumsum(wire_ns)
        # Several instructions in one write pass the wire one after the other.
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
        """The instructions in the recording, each once."""
        return tuple(self._exchanges)

    def newest(self, instruction: bytes) -> tuple[RecordedReply, ...]:
        """Return the answer to an instruction that `replay_answer` returned last, or the first recorded one
        if there was none."""
        return self._heard(self._exchanges[instruction][max(0, self._next[instruction] - 1)])

    def replay_answer(self, instruction: bytes) -> tuple[RecordedReply, ...] | None:
        """Return the next recorded answer to an instruction, or None if the instruction is not in the
        recording."""
        exchanges = self._exchanges.get(instruction)
        if exchanges is None:
            return None
        number = self._next[instruction]
        self._next[instruction] = min(number + 1, len(exchanges))
        return self._heard(exchanges[min(number, len(exchanges) - 1)])

    def _heard(self, exchange: int) -> tuple[RecordedReply, ...]:
        first = int(self._rows[exchange]) + 1
        end = int(self._rows[exchange + 1]) if exchange + 1 < len(self._rows) else len(self._start)
        return tuple(
            RecordedReply(delay_ns, self._data[start : start + length])
            for delay_ns, start, length in zip(
                self._delay_ns[first:end].tolist(),
                self._start[first:end].tolist(),
                self._length[first:end].tolist(),
                strict=True,
            )
        )
