"""Packets as the manual prints them, found among noise and however they are cut; reads that servos share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.packets import packet1, packet2

from dxlsim.wire import servo_protocol1, servo_protocol2
from dxlsim.wire.servo_packets import (
    BROADCAST,
    GroupRead,
    InstructionPacket,
    InstructionReceiver,
    ReadEntry,
    ServoReply,
)
from dxlsim.wire.servo_protocol2 import FastStatusPacket, crc16, stuffed, unstuffed

ONE, TWO = servo_protocol1.CODEC, servo_protocol2.CODEC
MANY = settings(max_examples=100, deadline=None)
BODIES = st.lists(st.sampled_from([0xFF, 0xFF, 0xFD, 0x00, 0x55]) | st.integers(0, 255), min_size=1).map(
    bytes
)
both = pytest.mark.parametrize("codec", [ONE, TWO], ids=["1.0", "2.0"])

# Packets of the e-Manual, pages "DYNAMIXEL Protocol 1.0" and "DYNAMIXEL Protocol 2.0": header and ID, length,
# instruction, parameters, checksum
INSTRUCTIONS = """
ffff01 02 01 | | fb
ffff01 04 02 | 2b01 | cc
fffffe 04 03 | 0301 | f6
ffff01 05 04 | 1ef401 | e2
fffffe 02 05 | | fa
ffff00 02 06 | | f7
fffffe 0e 83 | 1e0400100050010120026003 | 67
fffffe 09 92 | 0002011e020224 | 1d
ffff01 05 03 | 0c64aa | dc
fffffd0001 0300 01 | | 194e
fffffd00fe 0300 01 | | 3142
fffffd0001 0700 02 | 84000400 | 1d15
fffffd0001 0900 03 | 740000020000 | ca89
fffffd0001 0900 04 | 6800c8000000 | ae8e
fffffd0001 0300 05 | | 02ce
fffffd0001 0400 06 | 01 | a1e6
fffffd0001 0300 08 | | 2f4e
fffffd0001 0800 10 | 0144584c22 | b1dc
fffffd00fe 0900 82 | 840004000102 | cefa
fffffd00fe 1100 83 | 74000400019600000002aa000000 | 8287
fffffd00fe 0d00 92 | 01900002000292000100 | 1a05
fffffd00fe 1000 93 | 0120000200a000021f00010050 | b768
"""
STATUSES = """
ffff01 02 00 | | fc
ffff01 02 24 | | d8
ffff01 03 00 | 20 | db
ffff00 02 00 | | fd
ffff01 04 00 | 0080 | 7a
ffff02 04 00 | 0080 | 79
fffffd0001 0700 5500 | 060426 | 655d
fffffd0002 0700 5500 | 060426 | 6f6d
fffffd0001 0800 5500 | a6000000 | 8cc0
fffffd0002 0800 5500 | 1f080000 | babe
fffffd0001 0600 5500 | 7700 | c369
fffffd0002 0500 5500 | 24 | 8ba9
fffffd0001 0400 5500 | | a10c
"""


def found_in(receiver: InstructionReceiver, data: bytes) -> Iterator[InstructionPacket]:
    at = 0
    while (packet := receiver.feed_bytes(data, at)) is not None:
        assert at < packet.end <= len(data)
        at = packet.end
        yield packet


@pytest.mark.parametrize("text", INSTRUCTIONS.strip().splitlines())
def test_instructions_of_the_manual_are_understood(text):
    head, parameters, end = (bytes.fromhex(part) for part in text.split("|"))
    codec, data = (TWO if head.startswith(TWO.header) else ONE), head + parameters + end
    packet = InstructionPacket(head[len(codec.header)], head[-1], parameters, True, len(data), data)
    assert list(found_in(InstructionReceiver(codec), data)) == [packet]


@pytest.mark.parametrize("text", STATUSES.strip().splitlines())
def test_status_packets_are_those_of_the_manual(text):
    head, parameters, end = (bytes.fromhex(part) for part in text.split("|"))
    codec = TWO if head.startswith(TWO.header) else ONE
    assert codec.status_packet(head[len(codec.header)], head[-1], parameters) == head + parameters + end


@pytest.mark.parametrize(
    ("codec", "text"),
    [(ONE, "ff ff 01 04 02 2b 01 cc"), (TWO, "fffffd0001 0700 02 84000400 1d15")],
    ids=["1.0", "2.0"],
)
def test_one_wrong_bit_behind_the_header_never_goes_unseen(codec, text):
    for index in range(len(codec.header), len(bytes.fromhex(text))):
        data = bytearray.fromhex(text)
        data[index] ^= 0x10
        assert not any(packet.intact for packet in found_in(InstructionReceiver(codec), bytes(data)))


@pytest.mark.parametrize(
    ("codec", "text"),
    [
        (ONE, "ff ff ff 01 02 01 fb"),  # a third ff belongs to the header of the next packet
        (ONE, "ff ff 01 01 ff ff 01 02 01 fb"),  # a length below two is noise
        (TWO, "fffffd00 fd 0300 fffffd00 01 0300 01 194e"),  # IDs that cannot be
        (TWO, "fffffd00 ff 0300 fffffd00 01 0300 01 194e"),
    ],
)
def test_what_cannot_be_a_packet_hides_none(codec, text):
    (packet,) = found_in(InstructionReceiver(codec), bytes.fromhex(text))
    assert (packet.servo_id, packet.instruction, packet.intact) == (1, 0x01, True)


@pytest.mark.parametrize("servo_id", [0xFD, 0xFF])
def test_ids_that_cannot_be_begin_no_packet(servo_id):
    receiver = InstructionReceiver(TWO)
    assert receiver.feed_bytes(bytes((0xFF, 0xFF, 0xFD, 0x00, servo_id, 3, 0, 1))) is None
    assert receiver.pending < 3


def test_a_forgotten_begin_does_not_spoil_the_next_packet():
    receiver = InstructionReceiver(ONE)
    assert receiver.feed_bytes(bytes.fromhex("ff ff 01 04 02")) is None
    assert receiver.pending == 5
    receiver.discard_packet()
    assert next(found_in(receiver, bytes.fromhex("ff ff 01 02 01 fb"))).intact


@both
@MANY
@given(
    st.lists(
        st.tuples(
            st.lists(st.sampled_from([0xFD, 0x00, 0x01, 0x55])).map(bytes),
            st.integers(0, 252),
            st.integers(0, 255),
            BODIES,
        ),
        min_size=1,
        max_size=4,
    ),
    st.lists(st.integers(1, 20), min_size=1, max_size=20),
)
def test_every_packet_between_noise_is_found_once_however_it_is_cut(codec, packets, cuts):
    line = b""
    for noise, servo_id, instruction, parameters in packets:
        made = packet1(servo_id, instruction, *parameters), packet2(servo_id, instruction, parameters)
        line += noise + made[codec is TWO]
    receiver, found, at = InstructionReceiver(codec), [], 0
    while at < len(line):
        piece = line[at : at + cuts[at % len(cuts)]]
        at += len(piece)
        found += found_in(receiver, piece)
    assert [(each.servo_id, each.instruction, each.parameters) for each in found] == [p[1:] for p in packets]
    assert all(each.intact for each in found)
    assert receiver.pending == 0


@both
@MANY
@given(st.binary(max_size=400), st.lists(st.integers(1, 60), min_size=1))
def test_how_any_bytes_are_cut_makes_no_difference(codec, data, sizes):
    data = data.replace(b"\x80", codec.header)  # headers are rare in random bytes
    whole = [(each.parameters, each.intact) for each in found_in(InstructionReceiver(codec), data)]
    receiver, pieces, at = InstructionReceiver(codec), [], 0
    while at < len(data):
        size = sizes[at % len(sizes)]
        pieces += found_in(receiver, data[at : at + size])
        at += size
        assert codec is TWO or receiver.pending <= servo_protocol1.LONGEST
    assert [(each.parameters, each.intact) for each in pieces] == whole


@MANY
@given(BODIES)
def test_stuffing_hides_every_header_and_comes_off_again(body):
    assert unstuffed(stuffed(body)) == body
    assert b"\xff\xff\xfd\x00" not in stuffed(body)


def test_crc_and_stuffing_are_those_of_the_catalogue_and_the_manual():
    assert crc16(b"123456789") == 0xFEE8  # CRC-16/UMTS
    examples = ("fffffd", "fffffdfd"), ("03fffffdfd00", "03fffffdfdfd00"), ("fffffffffd", "fffffffffdfd")
    for plain, hidden in examples:
        assert stuffed(bytes.fromhex(plain)) == bytes.fromhex(hidden)


def fast(lengths: tuple[int, ...], *replies: tuple[int, int, str]) -> bytes:
    """Return the packet of a fast read, put together by servos."""
    status = FastStatusPacket(lengths)
    parts = (status.part(ServoReply(each, error, bytes.fromhex(data), 0)) for each, error, data in replies)
    return b"".join(parts)


def test_fast_status_has_the_manual_s_form_and_is_not_stuffed():
    whole = fast((4, 4), (1, 0, "a6000000"), (2, 0x80, "1f080000"))
    assert whole[:8] == bytes.fromhex("fffffd00 fe 1100 55")
    assert int.from_bytes(whole[5:7], "little") == len(whole) - 7
    assert (whole[8:14], whole[16:22]) == (bytes.fromhex("0001a6000000"), bytes.fromhex("80021f080000"))
    for end in (14, 22):
        assert int.from_bytes(whole[end : end + 2], "little") == crc16(whole[:end])
    assert fast((4, 2, 1), (3, 0, "a6000000"), (7, 0, "a501"), (4, 0, "1f")) == bytes.fromhex(
        "fffffd00 fe 1400 55 00 03 a6000000 67a4  00 07 a501 2474  00 04 1f d9c1"
    )
    assert bytes.fromhex("fffffd00") in fast((4,), (1, 0, "fffffd00"))[8:]


@pytest.mark.parametrize(
    ("codec", "instruction", "parameters", "entries"),
    [
        (ONE, 0x92, "00 02 01 1e 02 02 24", [(1, 0x1E, 2), (2, 0x24, 2)]),
        (TWO, 0x82, "84000400 0102", [(1, 132, 4), (2, 132, 4)]),
        (TWO, 0x8A, "84000400 0201", [(2, 132, 4), (1, 132, 4)]),
        (TWO, 0x92, "0190000200 0292000100", [(1, 144, 2), (2, 146, 1)]),
        (TWO, 0x9A, "0190000200", [(1, 144, 2)]),
        (ONE, 0x92, "01 02 01 1e 02 02 24", None),  # the first parameter is not 0
        (ONE, 0x92, "00 02 01 1e 02 02", None),
        (ONE, 0x92, "00", None),
        (ONE, 0x82, "00 02 01 1e 02 02 24", None),
        (TWO, 0x82, "84000400", None),  # no servo is listed
        (TWO, 0x92, "01900002", None),
        (TWO, 0x02, "84000400", None),
    ],
)
def test_reads_in_turn_are_understood(codec, instruction, parameters, entries):
    packet = InstructionPacket(BROADCAST, instruction, bytes.fromhex(parameters), intact=True, end=0)
    together = instruction in (0x8A, 0x9A)
    listed = tuple(ReadEntry(*each) for each in entries or ())
    read = GroupRead(instruction, listed, fast=together, has_slots=codec is TWO and not together)
    assert codec.group_read(packet) == (read if entries else None)
    assert codec.group_read(packet._replace(servo_id=1)) is None
    assert codec.group_read(packet._replace(intact=False)) is None
