"""Packet batches: every byte that goes in comes out, whatever the sizes."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun.packets import (
    PACKET_SLOT,
    LoggedPacket,
    NoPackets,
    PacketBatch,
    PacketKind,
    decode_packets,
    packet_slots,
)
from dxlrun.ring import Handover

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


@settings(max_examples=100, deadline=None)
@given(st.lists(st.one_of(PACKETS, st.just(None)), max_size=30))
def test_packets_come_out_as_they_went_in(steps: list[LoggedPacket | None]) -> None:
    slots: list[bytes] = []
    batch = PacketBatch(Handover(lambda payload: slots.append(bytes(payload)), slot_size=128))
    for step in [*steps, None]:
        if step is None:
            batch.commit()
        else:
            batch.packet(
                step.bus, step.kind, step.servo_id, step.first_ns, step.last_ns, bytearray(step.data)
            )
    assert [packet for slot in slots for packet in decode_packets(slot)] == [step for step in steps if step]
    assert all(0 < len(slot) <= 128 for slot in slots)


@given(st.binary(min_size=1, max_size=400))
@settings(max_examples=30, deadline=None)
def test_noise_longer_than_a_slot_is_cut_and_nothing_of_it_lost(noise: bytes) -> None:
    slots: list[bytes] = []
    batch = PacketBatch(Handover(lambda payload: slots.append(bytes(payload)), slot_size=64))
    batch.packet(0, PacketKind.NOISE, 254, 5, 9, memoryview(noise))
    batch.commit()
    pieces = [packet for slot in slots for packet in decode_packets(slot)]
    assert b"".join(piece.data for piece in pieces) == noise
    assert {(piece.kind, piece.first_ns, piece.last_ns) for piece in pieces} == {(PacketKind.NOISE, 5, 9)}


def test_a_commit_without_packets_takes_no_slot() -> None:
    slots: list[bytes] = []
    batch = PacketBatch(Handover(lambda payload: slots.append(bytes(payload))))
    batch.commit()
    assert slots == []


@pytest.mark.parametrize("cut", [1, 10, 23, 25])
def test_a_cut_batch_is_refused(cut: int) -> None:
    slots: list[bytes] = []
    batch = PacketBatch(Handover(lambda payload: slots.append(bytes(payload))))
    batch.packet(0, PacketKind.STATUS, 1, 2, 3, b"abc")
    batch.commit()
    with pytest.raises(ValueError, match="ends inside"):
        decode_packets(slots[0][:cut])


def test_a_slot_without_room_for_a_packet_is_refused() -> None:
    with pytest.raises(ValueError, match="holds no packet"):
        PacketBatch(Handover(lambda payload: None, slot_size=24))


@pytest.mark.parametrize(("rate", "servos"), [(50, 8), (1000, 20), (320, 1)])
def test_the_ring_holds_ten_seconds_of_a_robot(rate: int, servos: int) -> None:
    slots: list[bytes] = []
    batch = PacketBatch(Handover(lambda payload: slots.append(bytes(payload)), slot_size=PACKET_SLOT))
    for _ in range(servos):
        batch.packet(0, PacketKind.INSTRUCTION, 1, 0, 0, bytes(8))
        batch.packet(0, PacketKind.STATUS, 1, 0, 0, bytes(14))
    batch.packet(0, PacketKind.INSTRUCTION, 254, 0, 0, bytes(8 + 5 * servos))
    batch.commit()
    assert len(slots) * rate * 10 <= packet_slots(1_000_000_000 // rate, servos)


def test_without_a_log_packets_are_taken_and_forgotten() -> None:
    sink = NoPackets()
    sink.packet(0, PacketKind.NOISE, 1, 2, 3, b"abc")
    sink.commit()
