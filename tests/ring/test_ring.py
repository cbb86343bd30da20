"""Rings: what is delivered is what was appended, and what is not is declared."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun.run.channels import ring
from dxlrun.run.channels.ring import SLOT_HEADER, Gap, Handover, RingReader, RingWriter

HEADER = 64
Make = Callable[[int, int], int]


@pytest.fixture
def make() -> Iterator[Make]:
    descriptors: list[int] = []

    def create(slot_size: int, slots: int) -> int:
        descriptors.append(ring.create("test", slot_size, slots))
        return descriptors[-1]

    yield create
    for descriptor in descriptors:
        os.close(descriptor)


@settings(max_examples=80, deadline=None)
@given(
    slots=st.integers(2, 6),
    steps=st.lists(st.one_of(st.binary(max_size=24), st.just(None)), max_size=60),
)
def test_every_record_is_delivered_as_it_was_or_declared_lost(slots: int, steps: list[bytes | None]) -> None:
    descriptor = ring.create("property", 24, slots)
    try:
        writer, reader = RingWriter(descriptor), RingReader(descriptor)
        appended: list[bytes] = []
        seen = 0
        for step in [*steps, *([None] * (slots + 2))]:
            if step is not None:
                assert writer.append(step) == len(appended)
                appended.append(step)
                continue
            got = reader.read()
            if isinstance(got, Gap):
                # Nothing is given up that could still be read, but for the slot that is overwritten next.
                assert len(appended) - seen > slots
                seen += got.lost
            elif got is not None:
                assert got == appended[seen]
                seen += 1
        assert seen == len(appended)
        assert reader.read() is None
    finally:
        os.close(descriptor)


def test_a_damaged_record_is_one_gap_and_its_neighbours_stay(make: Make) -> None:
    descriptor = make(16, 4)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    for text in (b"one", b"two", b"three"):
        writer.append(text)
    second = HEADER + (SLOT_HEADER + 16) + SLOT_HEADER
    os.pwrite(descriptor, b"X", second)
    assert [reader.read() for _ in range(4)] == [b"one", Gap(1), b"three", None]


def test_a_length_out_of_bounds_is_a_gap(make: Make) -> None:
    descriptor = make(16, 4)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    writer.append(b"one")
    os.pwrite(descriptor, struct.pack("<I", 1 << 30), HEADER + 8)
    assert reader.read() == Gap(1)


def test_an_old_payload_under_a_new_number_does_not_pass(make: Make) -> None:
    descriptor = make(8, 2)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    writer.append(b"old")
    slot = os.pread(descriptor, SLOT_HEADER + 8, HEADER)
    writer.append(b"b")
    writer.append(b"new")
    os.pwrite(descriptor, slot[8:], HEADER + 8)  # all but the sequence number
    assert reader.read() == Gap(2)
    assert reader.read() == Gap(1)


def test_a_writer_that_laps_the_reader_in_the_middle_of_a_copy_is_noticed(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    descriptor = make(16, 4)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    writer.append(b"first")
    form = struct.Struct("=II")

    class Interrupted:
        @staticmethod
        def unpack_from(buffer: memoryview, offset: int) -> tuple[int, int]:
            found: tuple[int, int] = form.unpack_from(buffer, offset)
            monkeypatch.setattr(ring, "_LENGTH_CRC", form)
            for text in (b"b", b"c", b"d", b"fifth"):
                writer.append(text)
            return found

    monkeypatch.setattr(ring, "_LENGTH_CRC", Interrupted)
    assert reader.read() == Gap(1)
    assert [reader.read() for _ in range(5)] == [b"b", b"c", b"d", b"fifth", None]


def test_a_record_that_is_being_written_is_not_delivered(make: Make) -> None:
    descriptor = make(16, 4)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    os.pwrite(descriptor, b"half a rec", HEADER + SLOT_HEADER)
    assert reader.read() is None
    writer.append(b"whole")
    assert reader.read() == b"whole"


def test_a_second_writer_goes_on_where_the_first_ended(make: Make) -> None:
    descriptor = make(16, 4)
    reader = RingReader(descriptor)
    first = RingWriter(descriptor)
    first.append(b"a")
    first.close()
    assert RingWriter(descriptor).append(b"b") == 1
    assert [reader.read(), reader.read(), reader.read()] == [b"a", b"b", None]
    reader.close()


def test_a_record_longer_than_a_slot_is_refused_and_leaves_the_ring_whole(make: Make) -> None:
    descriptor = make(10, 4)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    assert writer.slot_size == 16  # whole words
    with pytest.raises(ValueError, match="does not fit"):
        writer.append(bytes(17))
    assert reader.read() is None


def test_nobody_can_shrink_a_ring_under_the_others(make: Make) -> None:
    with pytest.raises(PermissionError):
        os.ftruncate(make(16, 4), 64)


def test_what_is_no_ring_is_refused() -> None:
    descriptor = os.memfd_create("other")
    try:
        os.ftruncate(descriptor, 4096)
        with pytest.raises(ValueError, match="not a ring"):
            RingReader(descriptor)
    finally:
        os.close(descriptor)
    with pytest.raises(ValueError, match="at least"):
        ring.create("none", 0, 4)


WRITER = """
import sys
from dxlrun.run.channels.ring import RingWriter
writer = RingWriter(int(sys.argv[1]))
for number in range(int(sys.argv[2])):
    writer.append(b"%d " % number * 20)
"""


def test_a_reader_beside_a_writing_process_gets_or_misses_each_record_once(make: Make) -> None:
    descriptor, count = make(256, 16), 20_000
    reader = RingReader(descriptor)
    command = [sys.executable, "-c", WRITER, str(descriptor), str(count)]
    with subprocess.Popen(command, pass_fds=[descriptor]) as process:
        seen = 0
        while seen < count:
            ended = process.poll() is not None
            got = reader.read()
            if isinstance(got, Gap):
                seen += got.lost
            elif got is not None:
                assert got == b"%d " % seen * 20
                seen += 1
            elif ended:
                break
    assert process.returncode == 0
    assert seen == count


def test_a_handover_gives_each_record_at_once() -> None:
    taken: list[bytes] = []
    handover = Handover(lambda payload: taken.append(bytes(payload)), slot_size=8)
    assert [handover.append(b"a"), handover.append(bytearray(b"b"))] == [0, 1]
    assert taken == [b"a", b"b"]
    assert handover.slot_size == 8
