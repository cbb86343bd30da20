"""Slot: the newest sample of a sensor; shared memory of fixed size, one writer, readers that never wait.

Layout of the memory, little-endian, everything aligned to 8 bytes:

    header    samples ever written u64, state u64, texts ever written u64
    2 samples number u64 (counted from 1), time i64 (ns), values f64, CRC-32 of these u64
    text      number u64, length u64, CRC-32 of the bytes u64, bytes

The writer fills the sample that is not the newest, and counts it when it is whole: so a reader finds the
newest one untouched unless two more come while it copies, which the number and the CRC-32 show. It then keeps
what it had, and looks again in the next cycle.
"""

from __future__ import annotations

from enum import IntEnum, unique
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels import shared_memory
from dxlrun.channels.shared_memory import load, store

Floats = NDArray[np.float64]
LONGEST_TEXT = 480
"""Bytes; a longer one is cut."""

_SAMPLES, _STATE, _TEXTS = range(3)
_HEADER_WORDS = 3
_TEXT_WORDS = 3
_WORD = 8
_LAST = (1 << 64) - 1


@unique
class SlotState(IntEnum):
    """What the writer does."""

    STARTING = 0
    OPEN = 1
    """It samples."""
    FAILED = 2
    """Its device is not there; it tries again."""
    ENDED = 3
    """Its process is gone."""


def size(values: int) -> int:
    """Return how many bytes a slot needs for samples of so many values."""
    return _WORD * (_HEADER_WORDS + 2 * (values + 3) + _TEXT_WORDS) + LONGEST_TEXT


def create(name: str, values: int) -> int:
    """Return the descriptor of a fresh slot."""
    return shared_memory.create(name, size(values))


def private(values: int) -> memoryview:
    """Return a fresh slot in the memory of this process."""
    return memoryview(bytearray(size(values)))


class _Slot:
    """The memory, cut into its parts by its size: what is in it may have been overwritten by a driver."""

    __slots__ = ("_places", "_text", "_text_words", "_words", "values")

    def __init__(self, memory: memoryview) -> None:
        self._words = memory[: _WORD * _HEADER_WORDS].cast("Q")
        self.values = (len(memory) - size(0)) // (2 * _WORD)
        sample, begin = self.values + 3, _HEADER_WORDS
        array = np.frombuffer(memory, dtype=np.uint64, count=begin + 2 * sample + _TEXT_WORDS)
        self._places = tuple(array[begin + turn * sample : begin + (turn + 1) * sample] for turn in (0, 1))
        begin += 2 * sample
        self._text_words = memory[_WORD * begin : _WORD * (begin + _TEXT_WORDS)].cast("Q")
        self._text = memory[_WORD * (begin + _TEXT_WORDS) :][:LONGEST_TEXT]


class SlotWriter(_Slot):
    """The writer's end; one process at a time has it, a later one goes on counting."""

    __slots__ = ("_bytes", "_floats", "_sample")

    def __init__(self, memory: memoryview) -> None:
        super().__init__(memory)
        self._sample = np.zeros(self.values + 3, np.uint64)
        self._floats: Floats = self._sample[2:-1].view(np.float64)
        self._bytes = memoryview(self._sample.data).cast("B")[:-_WORD]

    def write(self, t_ns: int, values: Floats) -> None:
        """Leave a sample that was true at `t_ns`; never waits."""
        number = (self._words[_SAMPLES] + 1 & _LAST) or 1
        sample = self._sample
        sample[0], sample[1] = number, max(0, t_ns)
        np.copyto(self._floats, values)
        sample[-1] = crc32(self._bytes)
        np.copyto(self._places[number & 1], sample)
        store(self._words, _SAMPLES, number)  # the whole sample is seen before its count

    def say(self, state: SlotState, text: str) -> None:
        """Leave what the writer does now, and a sentence, in place of the one before."""
        data = text.encode(errors="replace")[:LONGEST_TEXT]
        words, number = self._text_words, (self._words[_TEXTS] + 1 & _LAST) or 1
        words[0], words[1], words[2] = number, len(data), crc32(data)
        self._text[: len(data)] = data
        store(self._words, _STATE, state)
        store(self._words, _TEXTS, number)


class SlotReader(_Slot):
    """A reader's end; nothing that it does waits, and `read` allocates nothing that stays."""

    __slots__ = ("_bytes", "_sample", "_seen", "_spoken", "sample")

    def __init__(self, memory: memoryview) -> None:
        super().__init__(memory)
        self._sample = np.zeros(self.values + 3, np.uint64)
        self._bytes = memoryview(self._sample.data).cast("B")[:-_WORD]
        self._seen = self._spoken = 0
        self.sample: Floats = self._sample[2:-1].view(np.float64)
        """The values that `read` copied; to be used only after it returned True."""

    @property
    def samples(self) -> int:
        """How many samples were ever written."""
        return self._words[_SAMPLES]

    @property
    def state(self) -> SlotState:
        """What the writer does; FAILED where that was overwritten."""
        word = self._words[_STATE]
        return SlotState(word) if word < len(SlotState) else SlotState.FAILED

    def read(self) -> int | None:
        """Copy the newest sample; return its time, ns, or None where there is no newer one, or it is torn."""
        if self._words[_SAMPLES] == self._seen:
            return None
        number, sample = load(self._words, _SAMPLES), self._sample  # which is no older than its count
        np.copyto(sample, self._places[number & 1])
        if sample.item(0) != number or sample.item(-1) != crc32(self._bytes):
            return None  # two more came meanwhile: they are there for the next look
        self._seen = number
        return sample.item(1)

    def hear(self) -> str:
        """Return the newest sentence if it was not returned before; empty where there is none."""
        number, words = load(self._words, _TEXTS), self._text_words
        if number == self._spoken:
            return ""
        data = bytes(self._text[: min(words[1], LONGEST_TEXT)])
        if words[0] != number or crc32(data) != words[2]:
            return ""  # another one is being written
        self._spoken = number
        return data.decode(errors="replace")
