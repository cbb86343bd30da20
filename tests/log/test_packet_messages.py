"""Packets are packed by a layout of their own: it is the one that the message's definition gives."""

from __future__ import annotations

from pathlib import Path

import pytest

from dxlrun.log import schemas
from dxlrun.log.log_writer import LogWriter
from dxlrun.log.reader import read_log
from dxlrun.log.schemas import LogHeader
from dxlrun.messages.cdr import Codec
from dxlrun.run.channels.packets import PacketBatch, PacketKind, decode_packets
from dxlrun.run.channels.ring import Handover

PACKETS = [
    (0, PacketKind.INSTRUCTION, 254, 1, 2, b"\xff\xff\xfe\x02\x01\xfe"),
    (1, PacketKind.STATUS, 0, 3, 2**62, bytes(range(256))),
    (0, PacketKind.NOISE, 255, 5, 5, b""),
]


def test_a_packet_in_a_log_is_the_message_of_its_definition(tmp_path: Path) -> None:
    log = LogWriter(tmp_path / "run.mcap", LogHeader("r", (), ("main", "arm"), (), 10**6, 0))
    batch = PacketBatch(Handover(log.take))
    for packet in PACKETS:
        batch.packet(*packet)
    batch.commit()
    log.close()

    codec = Codec(schemas.BUS_PACKET)
    written = {bus: list(messages) for bus, messages in read_log(tmp_path / "run.mcap").packet_messages}
    assert written == {
        bus: [codec.pack(*times, kind, who, data) for at, kind, who, *times, data in PACKETS if at == bus]
        for bus in (0, 1)
    }


def test_a_kind_that_is_none_is_refused(tmp_path: Path) -> None:
    slots: list[bytes] = []
    batch = PacketBatch(Handover(lambda _, payload: slots.append(bytes(payload))))
    batch.packet(*PACKETS[0])
    batch.commit()
    with pytest.raises(ValueError, match="kind 9"):
        decode_packets(slots[0].replace(b"\x00\x01\xfe", b"\x00\x09\xfe", 1))
