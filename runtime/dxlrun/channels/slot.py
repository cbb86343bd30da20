"""Slot: shared memory with the newest sample of a sensor, for one writer and readers that never wait.

Layout of the memory, little-endian, everything aligned to 8 bytes:

    header    number of samples written u64, state u64, number of texts written u64
    2 samples number u64 (counted from 1), time i64 (ns), values f64, CRC-32 of these u64
    text      number u64, length u64, CRC-32 of the bytes u64, bytes

The writer overwrites the older sample and increments the count afterwards. So the newest sample changes
during a reader's copy only if two samples are written in that time. The reader detects that by the number and
the CRC-32, keeps its last sample, and tries again in the next cycle.
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
"""Longest text that a slot holds, bytes; longer texts are cut."""

_SAMPLES, _STATE, _TEXTS = range(3)
_HEADER_WORDS = 3
_TEXT_WORDS = 3
_WORD = 8
_LAST = (1 << 64) - 1


@unique
class SlotState(IntEnum):
    """State of the source process that writes a slot."""

    STARTING = 0
    OPEN = 1
    """The device is open, and samples are written."""
    FAILED = 2
    """The device is not available; the writer tries again."""
    ENDED = 3
    """The source's process has exited."""


def size(values: int) -> int:
    """Return the size of a slot, bytes, for samples with this number of values."""
    return _WORD * (_HEADER_WORDS + 2 * (values + 3) + _TEXT_WORDS) + LONGEST_TEXT


def create(name: str, values: int) -> int:
    """Create a slot in shared memory for samples with this number of values; return its descriptor."""
    return shared_memory.create(name, size(values))


def private(values: int) -> memoryview:
    """Create a slot in private memory, for a reader in the same process."""
    return memoryview(bytearray(size(values)))


class _Slot:
    """Memory of a slot. Its size defines the layout, because a faulty driver may overwrite the content."""

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
    """Writer of a slot. A slot has one writer at a time.

    The slot keeps the numbers of the last sample and text, so a later writer continues to count from them.
    """

    __slots__ = ("_bytes", "_floats", "_sample")

    def __init__(self, memory: memoryview) -> None:
        super().__init__(memory)
        self._sample = np.zeros(self.values + 3, np.uint64)
        self._floats: Floats = self._sample[2:-1].view(np.float64)
        self._bytes = memoryview(self._sample.data).cast("B")[:-_WORD]

    def write_sample(self, t_ns: int, values: Floats) -> None:
        """Write a sample, measured at `t_ns` of the run's clock, in place of the older one. Never waits."""
        number = (self._words[_SAMPLES] + 1 & _LAST) or 1
        sample = self._sample
        sample[0], sample[1] = number, max(0, t_ns)
        np.copyto(self._floats, values)
        sample[-1] = crc32(self._bytes)
        np.copyto(self._places[number & 1], sample)
        store(self._words, _SAMPLES, number)  # release: the sample becomes visible before its number

    def write_state(self, state: SlotState, text: str) -> None:
        """Publish the writer's state and a text for an event, in place of the previous ones."""
        data = text.encode(errors="replace")[:LONGEST_TEXT]
        words, number = self._text_words, (self._words[_TEXTS] + 1 & _LAST) or 1
        words[0], words[1], words[2] = number, len(data), crc32(data)
        self._text[: len(data)] = data
        store(self._words, _STATE, state)
        store(self._words, _TEXTS, number)


class SlotReader(_Slot):
    """Reader of a slot. No method waits, and `read_sample` does not allocate memory that stays."""

    __slots__ = ("_bytes", "_sample", "_seen", "_spoken", "sample")

    def __init__(self, memory: memoryview) -> None:
        super().__init__(memory)
        self._sample = np.zeros(self.values + 3, np.uint64)
        self._bytes = memoryview(self._sample.data).cast("B")[:-_WORD]
        self._seen = self._spoken = 0
        self.sample: Floats = self._sample[2:-1].view(np.float64)
        """Values of the last sample; valid only if `read_sample` returned a time."""

    @property
    def samples(self) -> int:
        """Number of samples that were ever written."""
        return self._words[_SAMPLES]

    @property
    def state(self) -> SlotState:
        """State of the source that writes the slot; FAILED if the memory is damaged."""
        word = self._words[_STATE]
        return SlotState(word) if word < len(SlotState) else SlotState.FAILED

    def read_sample(self) -> int | None:
        """Copy the newest sample; return its time, ns, or None if it is not new or was torn."""
        if self._words[_SAMPLES] == self._seen:
            return None
        number, sample = load(self._words, _SAMPLES), self._sample  # at least as new as its count
        np.copyto(sample, self._places[number & 1])
        if sample.item(0) != number or sample.item(-1) != crc32(self._bytes):
            return None  # overwritten during the copy: the next call reads the newer sample
        self._seen = number
        return sample.item(1)

    def read_text(self) -> str:
        """Return the writer's newest text if it was not returned before, else an empty string."""
        number, words = load(self._words, _TEXTS), self._text_words
        if number == self._spoken:
            return ""
        data = bytes(self._text[: min(words[1], LONGEST_TEXT)])
        if words[0] != number or crc32(data) != words[2]:
            return ""  # another one is being written
        self._spoken = number
        return data.decode(errors="replace")
