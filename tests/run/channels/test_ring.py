"""Rings: what is delivered is what was appended, and what is not is declared."""

import os
import random
import struct
import subprocess
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun.channels import ring, shared_memory
from dxlrun.channels.ring import (
    RECORD_HEADER,
    Gap,
    Handover,
    Record,
    RecordKind,
    RingReader,
    RingWriter,
    record_size,
)
from dxlwire.exceptions import NotCompiled

HEADER = 64
HEAD, INTENT, LATEST, TAKEN, NUMBER = 24, 32, 40, 48, 56
KINDS = list(RecordKind)


@pytest.fixture
def make():
    descriptors: list[int] = []

    def create(capacity, longest):
        descriptors.append(ring.create("test", capacity, longest))
        return descriptors[-1]

    yield create
    for descriptor in descriptors:
        os.close(descriptor)


def event(payload: bytes) -> Record:
    return Record(RecordKind.TAGGED, payload)


def append(writer: RingWriter, *payloads: bytes) -> None:
    for payload in payloads:
        writer.append(RecordKind.TAGGED, payload)


def all_of(reader: RingReader) -> list[Record | Gap]:
    return list(iter(reader.read_record, None))


@settings(max_examples=150, deadline=None)
@given(
    capacity=st.integers(8, 40).map(lambda words: 8 * words),
    steps=st.lists(
        st.one_of(st.tuples(st.sampled_from(KINDS), st.binary(max_size=40)), st.just(None)), max_size=80
    ),
)
def test_every_record_is_delivered_as_it_was_or_declared_lost(capacity, steps):
    descriptor = ring.create("property", capacity, 40)
    try:
        writer, reader = RingWriter(descriptor), RingReader(descriptor)
        appended: list[tuple[RecordKind, bytes]] = []
        ends = [0]
        seen = 0
        for step in [*steps, *([None] * (capacity // RECORD_HEADER + 3))]:
            if step is not None:
                ends.append(writer.append(*step))
                appended.append(step)
                continue
            got = reader.read_record()
            if isinstance(got, Gap):
                # nothing is given up that was not overwritten, in whole or in part
                assert all(start < ends[-1] - capacity for start in ends[seen : seen + got.lost])
                seen += got.lost
            elif got is not None:
                assert got == appended[seen]
                seen += 1
        assert seen == len(appended)
        assert reader.read_record() is None
    finally:
        os.close(descriptor)


@pytest.mark.parametrize("number", [0, 1, 2])
def test_gap_has_a_record_at_least_where_the_count_of_records_is_damaged(make, number):
    descriptor = make(512, 64)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    append(writer, b"one", b"two")
    assert all_of(reader) == [event(b"one"), event(b"two")]
    append(writer, b"three")
    os.pwrite(descriptor, b"X", HEADER + 2 * record_size(3) + RECORD_HEADER)
    os.pwrite(descriptor, struct.pack("<Q", number), NUMBER)
    assert all_of(reader) == [Gap(1)]
    append(writer, b"four")
    assert all_of(reader) == [event(b"four")]


@pytest.mark.parametrize("at", range(record_size(3)))
def test_a_damaged_byte_is_one_gap_and_the_neighbours_stay(make, at):
    descriptor = make(512, 64)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    append(writer, b"one", b"two", b"three")
    place = HEADER + record_size(3) + at
    (byte,) = os.pread(descriptor, 1, place)
    os.pwrite(descriptor, bytes([byte ^ 0x41]), place)
    padding = at >= RECORD_HEADER + 3
    middle = event(b"two") if padding else Gap(1)
    assert all_of(reader) == [event(b"one"), middle, event(b"three")]


def test_damage_at_the_end_is_declared_at_once_and_exactly(make):
    descriptor = make(512, 64)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    append(writer, b"one", b"two")
    os.pwrite(descriptor, bytes(2 * record_size(3)), HEADER)
    assert all_of(reader) == [Gap(2)]
    append(writer, b"three", b"four")
    os.pwrite(descriptor, b"X", HEADER + writer._words[5] + RECORD_HEADER)
    assert all_of(reader) == [event(b"three"), Gap(1)]
    append(writer, b"five")
    assert all_of(reader) == [event(b"five")]


def test_without_the_compiled_functions_there_is_no_ring(tmp_path, make, monkeypatch):
    descriptor = make(256, 16)
    (tmp_path / "shared_memory.c").write_text("int changed;")
    monkeypatch.setattr(shared_memory, "SOURCE", tmp_path / "shared_memory.c")
    shared_memory.library.cache_clear()
    for end in RingWriter, RingReader:
        with pytest.raises(
            NotCompiled, match=r"^the compiled shared_memory is missing; install dxlrun again"
        ):
            end(descriptor)


def test_a_length_out_of_bounds_is_a_gap(make):
    descriptor = make(64, 16)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    append(writer, b"one")
    os.pwrite(descriptor, struct.pack("<I", 1 << 30), HEADER + 12)
    assert all_of(reader) == [Gap(1)]


def test_an_old_payload_under_a_new_number_does_not_pass(make):
    descriptor = make(2 * record_size(8), 8)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    append(writer, b"old.....")
    body = os.pread(descriptor, 12, HEADER + RECORD_HEADER - 4)
    append(writer, b"b.......", b"new.....")
    os.pwrite(descriptor, body, HEADER + RECORD_HEADER - 4)  # CRC and payload, under the new mark and number
    assert all_of(reader) == [Gap(1), event(b"b......."), Gap(1)]


def test_a_mark_inside_a_payload_is_not_taken_for_a_record(make):
    descriptor = make(256, 128)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    lure = b"".join(struct.pack("<Q", RECORD_HEADER + 8 * word + 1) for word in range(12))
    append(writer, lure, b"next")
    os.pwrite(descriptor, b"X", HEADER)
    assert all_of(reader) == [Gap(1), event(b"next")]


def test_the_way_to_the_next_record_is_bounded_by_the_longest(make):
    """Each second word of a damaged record looks like the begin of another one, as long as one can be."""
    descriptor = make(1 << 16, 4096)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    append(writer, bytes(4096 - 24), b"whole")
    os.pwrite(descriptor, b"".join(struct.pack("<QII", 16 * n + 1, 0, 4096) for n in range(250)), HEADER)
    assert all_of(reader) == [Gap(2)]  # to look behind the fifth of them would take too long


def test_a_record_that_is_being_written_is_not_delivered_and_what_it_overwrites_neither(make):
    """A writer that died in the middle of a record: it had raised `intent`, and nothing more is known."""
    descriptor = make(3 * record_size(8), 8)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    append(writer, b"first...", b"second..", b"third...")
    os.pwrite(descriptor, struct.pack("<Q", writer.head + record_size(8)), INTENT)
    os.pwrite(descriptor, b"half", HEADER + 4)
    assert all_of(reader) == [Gap(1), event(b"second.."), event(b"third...")]
    append(RingWriter(descriptor), b"fourth..")
    assert all_of(reader) == [event(b"fourth..")]


def test_numbers_go_round_without_a_gap(make):
    descriptor = make(256, 16)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    writer._words[NUMBER // 8] = reader._reader[1] = 2**32 - 2
    for text in (b"a", b"b", b"c"):
        append(writer, text)
        assert all_of(reader) == [event(text)]
    append(writer, *[b"lapped"] * 20)
    gap, *rest = all_of(reader)
    assert isinstance(gap, Gap)
    assert gap.lost + len(rest) == 20


def test_the_newest_record_alone(make):
    descriptor = make(128, 16)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    assert reader.newest() is None
    for number in range(50):
        append(writer, b"%d" % number)
        if number % 7 == 0:
            assert reader.newest() == event(b"%d" % number)
            assert reader.newest() is None
    append(writer, b"damaged")
    os.pwrite(descriptor, b"X", HEADER + (writer.head - record_size(7)) % 128 + RECORD_HEADER)
    assert reader.newest() is None
    append(writer, b"whole")
    assert reader.newest() == event(b"whole")
    append(writer, b"next")
    assert all_of(reader) == [event(b"next")]


def test_a_record_longer_than_the_longest_is_refused_and_leaves_the_ring_whole(make):
    descriptor = make(128, 10)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    with pytest.raises(ValueError, match="longer than the ring"):
        append(writer, bytes(11))
    assert reader.read_record() is None
    append(writer, bytes(10))
    assert reader.read_record() == event(bytes(10))


def test_a_ring_cannot_be_shrunk_under_its_readers(make):
    with pytest.raises(PermissionError):
        os.ftruncate(make(128, 16), 64)


def test_what_is_no_ring_is_refused():
    descriptor = os.memfd_create("other")
    try:
        os.ftruncate(descriptor, 4096)
        with pytest.raises(ValueError, match="not a ring"):
            RingReader(descriptor)
        os.pwrite(descriptor, b"dxlring2" + struct.pack("<QQ", 1 << 20, 16), 0)  # longer than its memory
        with pytest.raises(ValueError, match="not a ring"):
            RingReader(descriptor)
    finally:
        os.close(descriptor)
    for capacity, longest in ((64, 0), (32, 16)):
        with pytest.raises(ValueError, match="cannot hold"):
            ring.create("none", capacity, longest)


def test_any_bytes_in_any_place_raise_nothing_and_end(make):
    descriptor = make(1024, 200)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    chance = random.Random(8)
    delivered = 0
    for _ in range(2000):
        append(writer, chance.randbytes(chance.randrange(200)))
        place = chance.choice((HEAD, INTENT, LATEST, TAKEN, HEADER + chance.randrange(1024)))
        if chance.random() < 0.5:
            os.pwrite(descriptor, chance.randbytes(chance.randrange(1, 9)), place)
        for _ in range(20):
            if isinstance(reader.newest() if chance.random() < 0.1 else reader.read_record(), Record):
                delivered += 1
        if chance.random() < 0.1:  # the words that a writer owns, whole again
            os.pwrite(descriptor, struct.pack("<QQQ", 0, 0, 0), HEAD)
            writer, reader = RingWriter(descriptor), RingReader(descriptor)
    assert delivered > 100


WRITER = """
import random, sys
from dxlrun.channels.ring import RecordKind, RingWriter
writer, chance = RingWriter(int(sys.argv[1])), random.Random(4)
for number in range(int(sys.argv[2])):
    writer.append(RecordKind.PACKETS, b"%d " % number * chance.randrange(40))
"""


def test_a_reader_beside_a_writing_process_gets_or_misses_each_record_once(make):
    descriptor, count = make(2048, 400), 20_000
    reader, chance = RingReader(descriptor), random.Random(4)
    sent = [b"%d " % number * chance.randrange(40) for number in range(count)]
    command = [sys.executable, "-c", WRITER, str(descriptor), str(count)]
    with subprocess.Popen(command, pass_fds=[descriptor]) as process:
        seen = gaps = 0
        while seen < count:
            ended = process.poll() is not None
            got = reader.read_record()
            if isinstance(got, Gap):
                seen, gaps = seen + got.lost, gaps + 1
            elif got is not None:
                assert got == (RecordKind.PACKETS, sent[seen])
                seen += 1
            elif ended:
                break
    assert process.returncode == 0
    assert seen == count


def test_a_queue_knows_how_far_its_reader_is(make):
    descriptor = make(128, 16)
    writer, reader = RingWriter(descriptor), RingReader(descriptor)
    append(writer, b"one", b"two")
    assert writer.taken == 0
    assert reader.read_record() == event(b"one")
    reader.report_taken()
    assert writer.taken == record_size(3)
    assert reader.newest() == event(b"two")
    reader.report_taken()
    assert writer.taken == writer.head


def test_a_handover_gives_each_record_at_once():
    taken: list[tuple[RecordKind, bytes]] = []
    handover = Handover(lambda kind, payload: taken.append((kind, bytes(payload))))
    assert handover.head == 0
    assert handover.append(RecordKind.TAGGED, b"a") == 1
    assert handover.append(RecordKind.CYCLE, bytearray(b"b")) == handover.head == 2
    assert taken == [(RecordKind.TAGGED, b"a"), (RecordKind.CYCLE, b"b")]
