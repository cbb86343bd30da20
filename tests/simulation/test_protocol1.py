from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun.simulation.wire.packets import InstructionPacket
from dxlrun.simulation.wire.protocol1 import LONGEST, InstructionReceiver, group_read, status_packet

# e-Manual, Protocol 1.0, "Instruction Details" and "Instruction Checksum"
GOLDEN_INSTRUCTIONS = {
    "ping": ("ff ff 01 02 01 fb", 0x01, 0x01, ""),
    "read present temperature": ("ff ff 01 04 02 2b 01 cc", 0x01, 0x02, "2b 01"),
    "broadcast write of an ID": ("ff ff fe 04 03 03 01 f6", 0xFE, 0x03, "03 01"),
    "reg write of a goal": ("ff ff 01 05 04 1e f4 01 e2", 0x01, 0x04, "1e f4 01"),
    "action": ("ff ff fe 02 05 fa", 0xFE, 0x05, ""),
    "factory reset": ("ff ff 00 02 06 f7", 0x00, 0x06, ""),
    "sync write": (
        "ff ff fe 0e 83 1e 04 00 10 00 50 01 01 20 02 60 03 67",
        0xFE,
        0x83,
        "1e 04 00 10 00 50 01 01 20 02 60 03",
    ),
    "bulk read": ("ff ff fe 09 92 00 02 01 1e 02 02 24 1d", 0xFE, 0x92, "00 02 01 1e 02 02 24"),
    "checksum of a write": ("ff ff 01 05 03 0c 64 aa dc", 0x01, 0x03, "0c 64 aa"),
}

# e-Manual, Protocol 1.0, "Status Packet" and "Instruction Details"
GOLDEN_STATUSES = [
    ("ff ff 01 02 00 fc", 1, 0, ""),
    ("ff ff 01 02 24 d8", 1, 0x24, ""),
    ("ff ff 01 03 00 20 db", 1, 0, "20"),
    ("ff ff 00 02 00 fd", 0, 0, ""),
    ("ff ff 01 04 00 00 80 7a", 1, 0, "00 80"),
    ("ff ff 02 04 00 00 80 79", 2, 0, "00 80"),
]


def all_packets(receiver: InstructionReceiver, data: bytes) -> list[InstructionPacket]:
    found = []
    position = 0
    while position < len(data):
        packet = receiver.feed(data, position)
        if packet is None:
            break
        assert position < packet.end <= len(data)
        position = packet.end
        found.append(packet)
    return found


@pytest.mark.parametrize("name", GOLDEN_INSTRUCTIONS)
def test_examples_of_the_manual_are_understood(name):
    data, servo_id, instruction, parameters = GOLDEN_INSTRUCTIONS[name]
    found = all_packets(InstructionReceiver(), bytes.fromhex(data))
    assert [(each.servo_id, each.instruction, each.parameters, each.intact) for each in found] == [
        (servo_id, instruction, bytes.fromhex(parameters), True)
    ]


@pytest.mark.parametrize(
    ("servo_id", "parameters", "entries"),
    [
        (0xFE, "00 02 01 1e 02 02 24", [(1, 0x1E, 2), (2, 0x24, 2)]),
        (0xFE, "01 02 01 1e 02 02 24", None),  # the first parameter is 0
        (0xFE, "00 02 01 1e 02 02", None),
        (0xFE, "00", None),
        (0x01, "00 02 01 1e 02 02 24", None),
    ],
)
def test_a_bulk_read_is_written_as_the_manual_says(servo_id, parameters, entries):
    read = group_read(InstructionPacket(servo_id, 0x92, bytes.fromhex(parameters), True, 0, b""))
    assert (None if read is None else [(*each,) for each in read.entries]) == entries


@pytest.mark.parametrize(("data", "servo_id", "error", "parameters"), GOLDEN_STATUSES)
def test_statuses_are_those_of_the_manual(data, servo_id, error, parameters):
    assert status_packet(servo_id, error, bytes.fromhex(parameters)) == bytes.fromhex(data)


@pytest.mark.parametrize("index", range(2, 8))
def test_one_wrong_bit_behind_the_header_never_goes_unseen(index):
    data = bytearray.fromhex("ff ff 01 04 02 2b 01 cc")
    data[index] ^= 0x10
    found = all_packets(InstructionReceiver(), bytes(data))
    assert not any(packet.intact for packet in found)


def test_a_third_ff_belongs_to_the_header_of_the_next_packet():
    found = all_packets(InstructionReceiver(), bytes.fromhex("ff ff ff 01 02 01 fb"))
    assert [(packet.servo_id, packet.intact) for packet in found] == [(1, True)]


def test_a_length_below_two_is_noise():
    found = all_packets(InstructionReceiver(), bytes.fromhex("ff ff 01 01 ff ff 01 02 01 fb"))
    assert [(packet.servo_id, packet.intact) for packet in found] == [(1, True)]


def test_a_forgotten_begin_does_not_spoil_the_next_packet():
    receiver = InstructionReceiver()
    assert receiver.feed(bytes.fromhex("ff ff 01 04 02")) is None
    assert receiver.pending == 5
    receiver.forget()
    assert all_packets(receiver, bytes.fromhex("ff ff 01 02 01 fb"))[0].intact


intact_packets = st.builds(
    lambda servo_id, instruction, parameters: (
        body := bytes((servo_id, len(parameters) + 2, instruction)) + parameters,
        b"\xff\xff" + body + bytes((~sum(body) & 0xFF,)),
    )[1],
    st.integers(0, 0xFE),
    st.integers(0, 0xFF),
    st.binary(max_size=253),
)
noise = st.binary(max_size=20).map(lambda data: data.replace(b"\xff", b"\x00"))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(noise, intact_packets), max_size=6))
def test_every_packet_between_noise_is_delivered_once(parts):
    line = b"".join(before + packet for before, packet in parts)
    found = all_packets(InstructionReceiver(), line)
    assert [(each.servo_id, each.instruction, each.parameters) for each in found] == [
        (packet[2], packet[4], packet[5:-1]) for _, packet in parts
    ]
    assert all(each.intact for each in found)


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=400), st.lists(st.integers(1, 60), min_size=1))
def test_how_bytes_are_cut_makes_no_difference(data, sizes):
    data = data.replace(b"\x80", b"\xff\xff")  # headers are rare in random bytes
    whole = [(each.parameters, each.intact) for each in all_packets(InstructionReceiver(), data)]
    receiver = InstructionReceiver()
    pieces = []
    position = 0
    while position < len(data):
        size = sizes[position % len(sizes)]
        pieces += all_packets(receiver, data[position : position + size])
        position += size
        assert receiver.pending <= LONGEST
    assert [(each.parameters, each.intact) for each in pieces] == whole
