"""Packet batches: every byte that goes in comes out, whatever the sizes."""

import os
import struct

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tests.kit.decoded import decode_packets

from dxlrun.channels.logged_packets import (
    DESK_SIZE,
    LONGEST_BATCH,
    LoggedPacket,
    PacketBatch,
    packet_capacity,
    salvage,
    split_packets,
)
from dxlrun.channels.ring import Handover, Payload, RecordKind, RingReader, RingWriter, create, record_size
from dxlwire.packets import PacketKind

TIMES = st.integers(-(2**63), 2**63 - 1)
PACKETS = st.builds(
    LoggedPacket,
    bus=st.integers(0, 255),
    kind=st.sampled_from(PacketKind),
    servo_id=st.integers(0, 255),
    first_ns=TIMES,
    last_ns=TIMES,
    data=st.binary(min_size=1, max_size=90),
)


def collected() -> tuple[list[bytes], Handover]:
    """The batches that a writer gets, and the writer."""
    batches: list[bytes] = []

    def take(kind: RecordKind, payload: Payload) -> None:
        assert kind is RecordKind.PACKETS
        batches.append(bytes(payload))

    return batches, Handover(take)


def desk_of(room: int) -> memoryview:
    """Memory of an unfinished batch of at most so many bytes."""
    return memoryview(bytearray(DESK_SIZE - LONGEST_BATCH + room))


@settings(max_examples=30, deadline=None)
@example(bytes(range(256)))
@given(st.binary(min_size=1, max_size=400))
def test_noise_longer_than_the_desk_is_cut_and_nothing_of_it_lost(noise):
    slots, writer = collected()
    batch = PacketBatch(writer, desk_of(64))
    batch.packet(0, PacketKind.NOISE, 254, 5, 9, memoryview(noise))
    batch.commit_packets()
    pieces = [packet for slot in slots for packet in decode_packets(slot)]
    assert b"".join(piece.data for piece in pieces) == noise
    assert {(piece.kind, piece.first_ns, piece.last_ns) for piece in pieces} == {(PacketKind.NOISE, 5, 9)}


@pytest.mark.parametrize("cut", [17, 26, 39, 41])
def test_a_cut_batch_is_refused(cut):
    slots, writer = collected()
    batch = PacketBatch(writer)
    batch.packet(0, PacketKind.STATUS, 1, 2, 3, b"abc")
    batch.commit_packets()
    with pytest.raises(ValueError, match="ends inside"):
        decode_packets(slots[0][:cut])


def test_a_desk_without_room_for_a_packet_is_refused():
    with pytest.raises(ValueError, match="cannot hold a packet"):
        PacketBatch(collected()[1], desk_of(40))


@pytest.mark.parametrize(("rate", "servos"), [(50, 8), (1000, 20), (320, 1)])
def test_the_ring_holds_ten_seconds_of_a_robot(rate, servos):
    slots, writer = collected()
    batch = PacketBatch(writer)
    for _ in range(servos):
        batch.packet(0, PacketKind.INSTRUCTION, 1, 0, 0, bytes(8))
        batch.packet(0, PacketKind.STATUS, 1, 0, 0, bytes(14))
    batch.packet(0, PacketKind.INSTRUCTION, 254, 0, 0, bytes(8 + 5 * servos))
    batch.commit_packets()
    (cycle,) = slots  # nothing is committed in the middle
    assert len(cycle) <= LONGEST_BATCH
    assert record_size(len(cycle)) * rate * 10 <= packet_capacity(1_000_000_000 // rate, servos)


def cycles_of(batches: list[bytes]) -> list[tuple[int, bytes]]:
    return [(packet[0], packet[-1]) for batch in batches for packet in split_packets(batch)]


def test_each_packet_has_the_cycle_in_whose_period_it_was():
    slots, writer = collected()
    batch = PacketBatch(writer, desk_of(120))

    def packets(*names):
        for name in names:
            batch.packet(0, PacketKind.STATUS, 1, 2, 3, name)

    packets(b"set-up")
    batch.commit_packets()
    batch.wake(0)
    packets(b"0")
    batch.commit_packets()  # nothing in the idle time
    batch.wake(1)
    packets(b"1")
    batch.commit_packets()
    packets(b"idle of 1")
    batch.wake(5)  # cycles were skipped
    batch.commit_packets()
    batch.wake(6)  # no packet in its own time
    batch.commit_packets()
    packets(b"idle of 6", b"more", b"and more", b"which do not fit any more")
    batch.wake(9)
    packets(b"9")
    batch.commit_packets()
    assert cycles_of(slots) == [
        (-1, b"set-up"),
        (0, b"0"),
        (1, b"1"),
        (1, b"idle of 1"),
        (6, b"idle of 6"),
        (6, b"more"),
        (6, b"and more"),
        (6, b"which do not fit any more"),
        (9, b"9"),
    ]
    assert len(slots) == 6  # one was full before its time


@settings(max_examples=50, deadline=None)
@given(st.lists(st.one_of(PACKETS, st.none(), st.integers(0, 2**40)), max_size=30))
def test_the_kernel_commits_to_a_ring_what_is_handed_over_elsewhere(steps):
    slots, writer = collected()
    descriptor = create("packets", 1 << 14, 144)
    ring, reader = RingWriter(descriptor), RingReader(descriptor)
    desks = desk_of(128), desk_of(128)
    batches = [PacketBatch(one, desk) for one, desk in zip((writer, ring), desks, strict=True)]
    for step in [*steps, None]:
        for batch in batches:
            if step is None:
                batch.commit_packets()
            elif isinstance(step, int):
                batch.wake(step)
            else:
                batch.packet(step.bus, step.kind, step.servo_id, step.first_ns, step.last_ns, step.data)
        assert desks[0][16:] == desks[1][16:]
        position = struct.unpack_from("<Q", desks[1], 8)[0]
        assert position == ring.head
    os.close(descriptor)
    found = list(iter(reader.read_record, None))
    assert [record.payload for record in found] == slots
    assert {record.kind for record in found} <= {RecordKind.PACKETS}


def test_what_a_dead_process_left_is_taken_up_once_and_keeps_its_cycles():
    _, writer = collected()
    desk = desk_of(200)
    batch = PacketBatch(writer, desk)
    assert salvage(desk, writer.head, writer) == -1
    batch.wake(7)
    batch.packet(0, PacketKind.STATUS, 1, 2, 3, b"committed")
    batch.commit_packets()
    batch.packet(0, PacketKind.STATUS, 1, 2, 3, b"idle")
    batch.wake(8)
    batch.packet(0, PacketKind.STATUS, 1, 2, 3, b"last")
    taken, guardian = collected()
    assert [salvage(desk, writer.head, guardian) for _ in range(2)] == [8, 8]
    assert cycles_of(taken) == [(7, b"idle"), (8, b"last")]
    after = PacketBatch(guardian, cycle=8)
    after.packet(0, PacketKind.INSTRUCTION, 1, 2, 3, b"torque off")
    after.commit_packets()
    assert cycles_of(taken)[2:] == [(8, b"torque off")]


class Killed(BaseException):
    """Stands for SIGKILL: nothing after it runs."""


class DyingWriter(Handover):
    """Dies after the record is in the ring, before its writer hears of it."""

    def append(self, kind: RecordKind, payload: Payload) -> int:
        super().append(kind, payload)
        raise Killed


def test_a_process_that_dies_between_append_and_clearing_leaves_nothing_twice():
    slots: list[bytes] = []
    writer = DyingWriter(lambda _, payload: slots.append(bytes(payload)))
    desk = desk_of(128)
    batch = PacketBatch(writer, desk)
    batch.packet(0, PacketKind.INSTRUCTION, 1, 2, 3, b"once")
    with pytest.raises(Killed):
        batch.commit_packets()
    taken, guardian = collected()
    salvage(desk, writer.head, guardian)
    assert (len(slots), len(taken)) == (1, 0)


def test_an_empty_or_a_scribbled_desk_gives_nothing():
    taken, guardian = collected()
    desk = desk_of(128)
    PacketBatch(guardian, desk).commit_packets()
    salvage(desk, guardian.head, guardian)
    desk[:8] = b"\xff" * 8
    salvage(desk, guardian.head, guardian)
    assert taken == []
