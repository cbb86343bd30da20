from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun.simulation.wire.packets import GroupRead, InstructionPacket, ReadEntry, ServoReply
from dxlrun.simulation.wire.protocol2 import (
    FastStatusPacket,
    Instruction,
    InstructionReceiver,
    crc16,
    group_read,
    status_packet,
    stuffed,
    unstuffed,
)

# Instruction packets of the e-Manual, page "DYNAMIXEL Protocol 2.0", with what they mean.
GOLDEN_INSTRUCTIONS = {
    "ping": ("fffffd00 01 0300 01 194e", 1, Instruction.PING, ""),
    "ping of all": ("fffffd00 fe 0300 01 3142", 0xFE, Instruction.PING, ""),
    "read": ("fffffd00 01 0700 02 84000400 1d15", 1, Instruction.READ, "84000400"),
    "write": ("fffffd00 01 0900 03 740000020000 ca89", 1, Instruction.WRITE, "740000020000"),
    "reg write": ("fffffd00 01 0900 04 6800c8000000 ae8e", 1, Instruction.REG_WRITE, "6800c8000000"),
    "action": ("fffffd00 01 0300 05 02ce", 1, Instruction.ACTION, ""),
    "factory reset": ("fffffd00 01 0400 06 01 a1e6", 1, Instruction.FACTORY_RESET, "01"),
    "reboot": ("fffffd00 01 0300 08 2f4e", 1, Instruction.REBOOT, ""),
    "clear": ("fffffd00 01 0800 10 0144584c22 b1dc", 1, Instruction.CLEAR, "0144584c22"),
    "sync read": ("fffffd00 fe 0900 82 840004000102 cefa", 0xFE, Instruction.SYNC_READ, "840004000102"),
    "sync write": (
        "fffffd00 fe 1100 83 74000400 0196000000 02aa000000 8287",
        0xFE,
        Instruction.SYNC_WRITE,
        "74000400 0196000000 02aa000000",
    ),
    "bulk read": (
        "fffffd00 fe 0d00 92 0190000200 0292000100 1a05",
        0xFE,
        Instruction.BULK_READ,
        "0190000200 0292000100",
    ),
    "bulk write": (
        "fffffd00 fe 1000 93 0120000200a000 021f00010050 b768",
        0xFE,
        Instruction.BULK_WRITE,
        "0120000200a000 021f00010050",
    ),
}


@pytest.mark.parametrize("name", GOLDEN_INSTRUCTIONS)
def test_instructions_of_the_manual(name):
    text, servo_id, instruction, parameters = GOLDEN_INSTRUCTIONS[name]
    data = bytes.fromhex(text)
    assert InstructionReceiver().feed(data) == InstructionPacket(
        servo_id, instruction, bytes.fromhex(parameters), intact=True, end=len(data), raw=data
    )


@pytest.mark.parametrize(
    ("servo_id", "parameters", "text"),
    [
        (1, "060426", "fffffd00 01 0700 55 00 060426 655d"),
        (2, "060426", "fffffd00 02 0700 55 00 060426 6f6d"),
        (1, "a6000000", "fffffd00 01 0800 55 00 a6000000 8cc0"),
        (2, "1f080000", "fffffd00 02 0800 55 00 1f080000 babe"),
        (1, "7700", "fffffd00 01 0600 55 00 7700 c369"),
        (2, "24", "fffffd00 02 0500 55 00 24 8ba9"),
        (1, "", "fffffd00 01 0400 55 00 a10c"),
    ],
)
def test_status_packets_of_the_manual(servo_id, parameters, text):
    assert status_packet(servo_id, 0, bytes.fromhex(parameters)) == bytes.fromhex(text)


def test_crc_is_the_catalogue_s_crc_16_umts():
    assert crc16(b"123456789") == 0xFEE8


@pytest.mark.parametrize(
    "text",
    [
        "fffffd00 01 0300 01 194f",  # the CRC is wrong
        "fffffd00 01 0300 02 194e",  # and so is the instruction
    ],
)
def test_a_broken_packet_is_one_that_is_not_intact(text):
    packet = InstructionReceiver().feed(bytes.fromhex(text))
    assert packet is not None
    assert not packet.intact


BODIES = st.lists(st.sampled_from([0xFF, 0xFF, 0xFD, 0x00, 0x55]) | st.integers(0, 255), min_size=1).map(
    bytes
)


@settings(max_examples=300, deadline=None)
@given(BODIES)
def test_stuffing_hides_every_header_and_comes_off_again(body):
    assert unstuffed(stuffed(body)) == body
    assert b"\xff\xff\xfd\x00" not in stuffed(body)


def test_stuffing_as_in_the_manual():
    assert stuffed(bytes.fromhex("fffffd")) == bytes.fromhex("fffffdfd")
    assert stuffed(bytes.fromhex("03 fffffdfd 00")) == bytes.fromhex("03 fffffdfdfd 00")
    assert stuffed(bytes.fromhex("ffff fffffd")) == bytes.fromhex("ffff fffffdfd")


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 252), st.integers(0, 255), BODIES), min_size=1, max_size=4),
    st.lists(st.integers(1, 20), min_size=1, max_size=20),
)
def test_packets_are_found_however_they_are_cut(packets, cuts):
    line, expected = b"", []
    for servo_id, instruction, parameters in packets:
        body = stuffed(bytes((instruction,)) + parameters)
        head = b"\xff\xff\xfd\x00" + bytes((servo_id,)) + (len(body) + 2).to_bytes(2, "little")
        line += head + body + crc16(head + body).to_bytes(2, "little")
        expected.append((servo_id, instruction, parameters))
    receiver, found, at = InstructionReceiver(), [], 0
    while at < len(line):
        piece = line[at : at + cuts[at % len(cuts)]]
        at += len(piece)
        start = 0
        while (packet := receiver.feed(piece, start)) is not None:
            assert packet.intact
            found.append((packet.servo_id, packet.instruction, packet.parameters))
            start = packet.end
    assert found == expected
    assert receiver.pending == 0


@settings(max_examples=200, deadline=None)
@given(st.lists(st.sampled_from([0xFF, 0xFD, 0x01, 0x55])).map(bytes))
def test_noise_without_a_header_hides_no_packet(noise):
    ping = bytes.fromhex("fffffd00 01 0300 01 194e")
    packet = InstructionReceiver().feed(noise + ping)
    end = len(noise + ping)
    assert packet == InstructionPacket(1, Instruction.PING, b"", intact=True, end=end, raw=ping)


@pytest.mark.parametrize("servo_id", [0xFD, 0xFF])
def test_ids_that_cannot_be_begin_no_packet(servo_id):
    receiver = InstructionReceiver()
    assert receiver.feed(bytes((0xFF, 0xFF, 0xFD, 0x00, servo_id, 3, 0, 1))) is None
    assert receiver.pending < 3


def test_fast_status_of_the_manual_s_form():
    status = FastStatusPacket((4, 4))
    first = status.part(ServoReply(1, 0, bytes.fromhex("a6000000"), 0))
    second = status.part(ServoReply(2, 0x80, bytes.fromhex("1f080000"), 0))
    whole = first + second
    assert whole[:8] == bytes.fromhex("fffffd00 fe 1100 55")
    assert int.from_bytes(whole[5:7], "little") == len(whole) - 7
    assert whole[8:14] == bytes.fromhex("00 01 a6000000")
    assert whole[16:22] == bytes.fromhex("80 02 1f080000")
    assert int.from_bytes(whole[14:16], "little") == crc16(whole[:14])
    assert int.from_bytes(whole[22:24], "little") == crc16(whole[:22])


def test_fast_bulk_status_of_the_manual():
    status = FastStatusPacket((4, 2, 1))
    parts = [status.part(ServoReply(each, 0, bytes.fromhex(data), 0)) for each, data in FAST_BULK]
    assert b"".join(parts) == bytes.fromhex(
        "fffffd00 fe 1400 55 00 03 a6000000 67a4  00 07 a501 2474  00 04 1f d9c1"
    )


FAST_BULK = ((3, "a6000000"), (7, "a501"), (4, "1f"))


def test_fast_status_is_not_stuffed():
    data = bytes.fromhex("fffffd00")
    assert data + bytes(0) in FastStatusPacket((4,)).part(ServoReply(1, 0, data, 0))[8:]


@pytest.mark.parametrize(
    ("instruction", "parameters", "fast", "entries"),
    [
        (0x82, "84000400 0102", False, (ReadEntry(1, 132, 4), ReadEntry(2, 132, 4))),
        (0x8A, "84000400 0201", True, (ReadEntry(2, 132, 4), ReadEntry(1, 132, 4))),
        (0x92, "0190000200 0292000100", False, (ReadEntry(1, 144, 2), ReadEntry(2, 146, 1))),
        (0x9A, "0190000200", True, (ReadEntry(1, 144, 2),)),
    ],
)
def test_reads_in_turn(instruction, parameters, fast, entries):
    packet = InstructionPacket(0xFE, instruction, bytes.fromhex(parameters), intact=True, end=0)
    assert group_read(packet) == GroupRead(instruction, entries, fast=fast, has_slots=not fast)


@pytest.mark.parametrize(
    ("servo_id", "instruction", "parameters", "intact"),
    [
        (1, 0x82, "840004000102", True),  # not to all
        (0xFE, 0x82, "84000400", True),  # no servo is listed
        (0xFE, 0x92, "01900002", True),
        (0xFE, 0x02, "84000400", True),
        (0xFE, 0x82, "840004000102", False),
    ],
)
def test_what_is_no_group_read(servo_id, instruction, parameters, intact):
    packet = InstructionPacket(servo_id, instruction, bytes.fromhex(parameters), intact=intact, end=0)
    assert group_read(packet) is None
