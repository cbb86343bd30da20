"""Packets among noise and however they are cut, and whatever a host sends; dialogues/manual.txt has more."""

from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.packets import packet1, packet2
from tests.kit.simulated_line import Line, split_statuses

from bench import fuzz_simulation
from dxlsim.wire import servo_protocol1
from dxlsim.wire.compiled_line import InstructionReceiver, crc16, group_read, status_packet
from dxlsim.wire.servo_packets import BROADCAST, GroupRead, InstructionPacket, ReadEntry

ONE, TWO = 1.0, 2.0
HEADERS = {ONE: bytes.fromhex("ffff"), TWO: bytes.fromhex("fffffd00")}
MANY = settings(max_examples=100, deadline=None)
BODIES = st.lists(st.sampled_from([0xFF, 0xFF, 0xFD, 0x00, 0x55]) | st.integers(0, 255), min_size=1).map(
    bytes
)
both = pytest.mark.parametrize("protocol", [ONE, TWO])


def found_in(receiver: InstructionReceiver, data: bytes) -> Iterator[InstructionPacket]:
    at = 0
    while (packet := receiver.feed_bytes(data, at)) is not None:
        assert at < packet.end <= len(data)
        at = packet.end
        yield packet


@pytest.mark.parametrize(
    ("protocol", "text"),
    [(ONE, "ff ff 01 04 02 2b 01 cc"), (TWO, "fffffd0001 0700 02 84000400 1d15")],
    ids=["1.0", "2.0"],
)
def test_one_wrong_bit_behind_the_header_never_goes_unseen(protocol, text):
    for index in range(len(HEADERS[protocol]), len(bytes.fromhex(text))):
        data = bytearray.fromhex(text)
        data[index] ^= 0x10
        assert not any(packet.intact for packet in found_in(InstructionReceiver(protocol), bytes(data)))


@pytest.mark.parametrize(
    ("protocol", "text"),
    [
        (ONE, "ff ff ff 01 02 01 fb"),  # a third ff belongs to the header of the next packet
        (ONE, "ff ff 01 01 ff ff 01 02 01 fb"),  # a length below two is noise
        (TWO, "fffffd00 fd 0300 fffffd00 01 0300 01 194e"),  # IDs that cannot be
        (TWO, "fffffd00 ff 0300 fffffd00 01 0300 01 194e"),
    ],
)
def test_what_cannot_be_a_packet_hides_none(protocol, text):
    (packet,) = found_in(InstructionReceiver(protocol), bytes.fromhex(text))
    assert (packet.servo_id, packet.instruction, packet.intact) == (1, 0x01, True)


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
def test_every_packet_between_noise_is_found_once_however_it_is_cut(protocol, packets, cuts):
    line = b""
    for noise, servo_id, instruction, parameters in packets:
        made = packet1(servo_id, instruction, *parameters), packet2(servo_id, instruction, parameters)
        line += noise + made[protocol == TWO]
    receiver, found, at = InstructionReceiver(protocol), [], 0
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
def test_how_any_bytes_are_cut_makes_no_difference(protocol, data, sizes):
    data = data.replace(b"\x80", HEADERS[protocol])  # headers are rare in random bytes
    whole = [(each.parameters, each.intact) for each in found_in(InstructionReceiver(protocol), data)]
    receiver, pieces, at = InstructionReceiver(protocol), [], 0
    while at < len(data):
        size = sizes[at % len(sizes)]
        pieces += found_in(receiver, data[at : at + size])
        at += size
        assert protocol == TWO or receiver.pending <= servo_protocol1.LONGEST
    assert [(each.parameters, each.intact) for each in pieces] == whole


@MANY
@given(BODIES)
def test_stuffing_hides_every_header_and_comes_off_again(body):
    made = status_packet(TWO, 1, 0, body)
    assert b"\xff\xff\xfd\x00" not in made[4:]
    packet = InstructionReceiver(TWO).feed_bytes(made)  # a status packet has the error after its instruction
    assert (packet.intact, packet.instruction, packet.parameters) == (True, 0x55, b"\0" + body)


def test_crc_and_stuffing_are_those_of_the_catalogue_and_the_manual():
    assert crc16(b"123456789") == 0xFEE8  # CRC-16/UMTS
    examples = ("fffffd", "fffffdfd"), ("03fffffdfd00", "03fffffdfdfd00"), ("fffffffffd", "fffffffffdfd")
    for plain, hidden in examples:
        assert status_packet(TWO, 1, 0, bytes.fromhex(plain))[9:-2] == bytes.fromhex(hidden)


def test_data_of_a_fast_status_are_not_stuffed():
    line = Line("XL430-W250", 1)
    for number, byte in enumerate(bytes.fromhex("fffffd00"), 1):
        line.servo().poke(f"indirect_data_{number}", byte)
    address = line.item("indirect_data_1").address
    line.instruct(BROADCAST, 0x8A, line.word(address) + line.word(4) + b"\x01")
    assert line.receive()[8:14] == bytes.fromhex("0001 fffffd00")


@pytest.mark.parametrize(
    ("protocol", "instruction", "parameters", "entries"),
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
def test_reads_in_turn_are_understood(protocol, instruction, parameters, entries):
    packet = InstructionPacket(BROADCAST, instruction, bytes.fromhex(parameters), intact=True, end=0)
    listed = tuple(ReadEntry(*each) for each in entries or ())
    read = GroupRead(instruction, listed, fast=instruction in (0x8A, 0x9A))
    assert group_read(protocol, packet) == (read if entries else None)
    assert group_read(protocol, packet._replace(servo_id=1)) is None
    assert group_read(protocol, packet._replace(intact=False)) is None


LIKE_PACKETS = st.sampled_from([0xFF, 0xFD, 0xFE, 0x00, 0x01, 0x02, 0x03, 0x55, 0x74, 0x82, 0x83, 0x92])
NOISE = st.lists(LIKE_PACKETS | st.integers(0, 255), max_size=60).map(bytes)
INSTRUCTIONS = st.sampled_from([1, 2, 3, 4, 5, 8, 0x10, 0x20, 0x82, 0x83, 0x8A, 0x92, 0x93, 0x9A, 0x77])
"""Not the factory reset: after it the servo listens elsewhere."""
PACKETS = st.tuples(st.sampled_from([1, 0xFE]), INSTRUCTIONS, NOISE)
SMALL = settings(max_examples=60, deadline=None)


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_random_and_mutated_strings_do_no_harm_and_get_no_false_answer(protocol):
    tally = fuzz_simulation.campaign(protocol, 2_000, seed=7)
    assert tally.strings == 2_000
    assert tally.silent > 50
    assert tally.answers > 50


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_motion_does_not_depend_on_the_times_at_which_the_mechanics_are_stepped(protocol):
    fuzz_simulation.shake(protocol, 200, seed=7)


@pytest.mark.parametrize(
    "model", ["AX-12A", "MX-64", "XM430-W350", "XL-320", "YM070-210-M001", "PH42-020-S300"]
)
@SMALL
@given(st.lists(NOISE | PACKETS, max_size=5))
def test_noise_and_any_packet_get_whole_answers(model, pieces):
    line = Line(model, 1)
    line.bus.absent = "slot"
    for piece in pieces:
        line.send(piece if isinstance(piece, bytes) else line.packet(*piece))
        received = line.receive()
        if isinstance(piece, bytes) or piece[1] not in (0x8A, 0x9A):  # fast forms share a status
            split_statuses(received, line.protocol)
        line.wait(0.2 if line.protocol == 2.0 else 0.0)


@pytest.mark.parametrize("model", ["AX-12A", "XM430-W350"])
@pytest.mark.parametrize("answers", [False, True])
@SMALL
@given(st.binary(max_size=20), st.integers(0, 7), st.integers(0, 100))
def test_an_instruction_with_a_broken_checksum_is_never_obeyed(model, answers, parameters, bit, place):
    line = Line(model, 1)
    line.servo().answers_damaged = answers
    size, header = (49, 4) if line.protocol == 1.0 else (120, 7)
    before = line.read_bytes(0, size)
    packet = bytearray(line.packet(1, 0x03, line.word(line.item("torque_enable").address) + parameters))
    packet[header + place % (len(packet) - header)] ^= 1 << bit
    line.send(bytes(packet))
    assert line.statuses() == ([(1, 0x10 if line.protocol == 1.0 else 3, b"")] if answers else [])
    line.wait(0.1)
    assert line.read_bytes(0, size) == before
