"""Packets in a log: packed and read again, by rosbags too; damaged messages are left out and counted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.typesys.store import Typestore
from tests.kit.decoded import decode_packets

from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.logged_packets import BatchedPacket, PacketBatch
from dxlrun.channels.ring import Handover, RecordKind
from dxlrun.log import log_writer, schemas
from dxlrun.log.columns import PacketColumns
from dxlrun.log.log_reader import read_log
from dxlrun.log.log_writer import LogWriter
from dxlrun.log.packing.bus_messages import pack_packets, read_packets
from dxlrun.log.schemas import LogHeader
from dxlrun.messages.cdr import Codec
from dxlwire.packets import PacketKind

PACKETS = [
    (0, PacketKind.INSTRUCTION, 254, 1, 2, b"\xff\xff\xfe\x02\x01\xfe"),
    (1, PacketKind.STATUS, 0, 3, 2**62, bytes(range(256))),
    (0, PacketKind.NOISE, 255, 5, 5, b""),
]
TIMES = st.integers(0, 2**63 - 1)
BATCHED = st.tuples(
    st.integers(-1, 9),
    st.just(0),
    st.integers(1, 3),
    st.integers(0, 255),
    TIMES,
    TIMES,
    st.binary(max_size=40),
)
MESSAGES = st.lists(st.lists(BATCHED, min_size=1, max_size=9), min_size=1, max_size=6)
CODEC = Codec(schemas.BUS_PACKETS)


def laid(messages: list[bytes], front: int = 0) -> tuple[Any, ...]:
    sizes = np.array([len(message) for message in messages], np.int64)
    data = np.frombuffer(bytes(front) + b"".join(messages), np.uint8)
    return data, np.full(len(sizes), 3, np.uint8), np.cumsum(sizes) - sizes + front, sizes


def shown(packets: PacketColumns) -> list[tuple[Any, ...]]:
    return [(one.kind, one.servo_id, one.first_ns, one.last_ns, one.data) for one in packets]


@settings(max_examples=60, deadline=None)
@given(MESSAGES, st.integers(0, 9))
def test_what_is_packed_is_read_again_wherever_it_lies_and_by_rosbags(
    typestore: Typestore, messages: list[list[BatchedPacket]], front: int
) -> None:
    packed = [pack_packets(one) for one in messages]
    found, wrong = read_packets(*laid(packed, front))
    assert wrong == 0
    assert shown(found) == [packet[2:] for one in messages for packet in one]
    assert found.cycle.tolist() == [packet[0] for one in messages for packet in one]
    assert (found.bus == 3).all()
    theirs: Any = typestore.deserialize_cdr(packed[0], schemas.BUS_PACKETS.name)
    assert np.cumsum(theirs.cycle_delta).tolist() == [packet[0] for packet in messages[0]]
    assert np.cumsum(theirs.first_ns_delta).tolist() == [packet[4] for packet in messages[0]]
    assert bytes(theirs.kind) == bytes(packet[2] for packet in messages[0])
    assert bytes(theirs.data) == b"".join(packet[-1] for packet in messages[0])


@settings(max_examples=80, deadline=None)
@given(MESSAGES, st.data())
def test_a_message_that_is_damaged_is_left_out_and_counted_or_read(
    messages: list[list[BatchedPacket]], data: st.DataObject
) -> None:
    packed = [bytearray(pack_packets(one)) for one in messages]
    hit = data.draw(st.integers(0, len(packed) - 1))
    for _ in range(3):
        packed[hit][data.draw(st.integers(0, len(packed[hit]) - 1))] = data.draw(st.integers(0, 255))
    packed[hit] = packed[hit][: data.draw(st.integers(0, len(packed[hit])))]
    found, wrong = read_packets(*laid([bytes(one) for one in packed]))
    others = [packet[2:] for at, one in enumerate(messages) for packet in one if at != hit]
    if wrong:
        assert shown(found) == others
    else:
        assert len(found) >= len(others)


KIND_AT, LENGTH_AT, DATA_AT = 80, 96, 100
"""Of the first kind, of the first length, of the number of bytes in a message of two packets."""


@pytest.mark.parametrize("all_of_them", [False, True])
@pytest.mark.parametrize(
    ("at", "value"),
    [(0, 1), (1, 9), (4, 1), (KIND_AT, 0), (KIND_AT, 7), (LENGTH_AT, 2), (DATA_AT, 3)],
    ids=["no CDR", "another CDR", "count", "kind 0", "kind 7", "length", "bytes"],
)
def test_what_contradicts_itself_is_left_out(at: int, value: int, all_of_them: bool) -> None:
    packets = [(7, 0, PacketKind.STATUS, 1, 5, 6, b"abc"), (7, 0, PacketKind.NOISE, 2, 7, 8, b"d")]
    good = pack_packets(packets)
    assert (good[KIND_AT], good[LENGTH_AT], good[DATA_AT]) == (PacketKind.STATUS, 3, 4)
    wrong = bytearray(good)
    wrong[at] = value
    found, lost = read_packets(*laid([bytes(wrong)] + [good] * (not all_of_them)))
    assert lost == 1
    assert shown(found) == ([] if all_of_them else [packet[2:] for packet in packets])


def test_a_message_has_the_packets_of_a_bus_in_many_cycles(tmp_path: Path) -> None:
    log = LogWriter(tmp_path / "run.mcap", LogHeader("r", (), ("main", "arm"), (), 10**6, 0))
    batch = PacketBatch(Handover(log.write_record))
    batch.packet(*PACKETS[0])
    batch.commit_packets()
    for cycle in (0, 1, 249, 251):
        batch.wake(cycle)
        for packet in PACKETS:
            batch.packet(*packet)
        batch.commit_packets()
        batch.packet(0, PacketKind.NOISE, 9, 6, 6, b"idle")
    batch.commit_packets()
    log.close()

    path = tmp_path / "run.mcap"
    with path.open("rb") as stream:
        written = [
            (channel.topic, len(set(np.cumsum(CODEC.unpack(message.data)["cycle_delta"]).tolist())))
            for _, channel, message in make_reader(stream).iter_messages(log_time_order=False)
        ]
    assert written == [("/bus/main", 4), ("/bus/arm", 2), ("/bus/main", 2), ("/bus/arm", 2)]
    packets = read_log(path).packets
    main = packets.select_rows(packets.bus == 0)
    assert list(zip(main.cycle.tolist(), main.servo_id.tolist(), strict=True)) == [
        (-1, 254),
        *((cycle, servo_id) for cycle in (0, 1, 249, 251) for servo_id in (254, 255, 9)),
    ]
    assert packets.cycle[packets.bus == 1].tolist() == [0, 1, 249, 251]
    assert [one.first_ns for one in main] == [1, *(1, 5, 6) * 4]


def test_a_chunk_has_the_packets_of_its_cycles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A recorder that is killed leaves whole chunks, and no cycle in them whose packets are missing."""
    monkeypatch.setattr(log_writer, "CHUNK_BYTES", 2000)
    header = LogHeader("r", (), ("main",), (), 10**6, 0)
    log, record = LogWriter(tmp_path / "run.mcap", header), CycleRecord(header.layout)
    batch = PacketBatch(Handover(log.write_record))
    for cycle in range(100):
        batch.wake(cycle)
        batch.packet(*PACKETS[0])
        batch.commit_packets()
        record.cycle = cycle
        log.write_record(RecordKind.CYCLE, record.raw)
    read = read_log(tmp_path / "run.mcap")
    assert 80 < len(read.cycles) < 100
    assert not read.complete
    assert read.packets.cycle.tolist() == read.cycles["cycle"].tolist()


def test_a_kind_that_is_none_is_refused(tmp_path: Path) -> None:
    slots: list[bytes] = []
    batch = PacketBatch(Handover(lambda _, payload: slots.append(bytes(payload))))
    batch.packet(*PACKETS[0])
    batch.commit_packets()
    with pytest.raises(ValueError, match="kind 9"):
        decode_packets(slots[0].replace(b"\x00\x01\xfe", b"\x00\x09\xfe", 1))
