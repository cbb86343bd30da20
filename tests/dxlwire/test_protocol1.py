"""Packets of Protocol 1.0: the e-Manual's own, and what cannot be one."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlwire.wire import protocol1 as p1
from dxlwire.wire.protocol1 import Status, StatusError

ids = st.integers(0, p1.HIGHEST_ID)
GOALS = {0: "10 00 50 01", 1: "20 02 60 03", 2: "30 00 70 01", 3: "20 02 80 03"}


def parsed(packet):
    """Return the status of a whole packet; None: header, length or checksum are wrong."""
    view = memoryview(bytes(packet))
    whole = packet.startswith(p1.HEADER) and p1.size_at(view, 0, len(view)) == len(view)
    return p1.opened(view) if whole and p1.intact(view) else None


@pytest.mark.parametrize(
    ("packet", "example"),
    [
        (p1.ping(1), "ff ff 01 02 01 fb"),
        (p1.read_range(1, 0x2B, 1), "ff ff 01 04 02 2b 01 cc"),
        (p1.write_range(0xFE, 3, b"\x01"), "ff ff fe 04 03 03 01 f6"),
        (p1.factory_reset(0), "ff ff 00 02 06 f7"),
        (
            p1.sync_write(30, 4, {servo_id: bytes.fromhex(data) for servo_id, data in GOALS.items()}),
            "ff ff fe 18 83 1e 04 00 10 00 50 01 01 20 02 60 03 02 30 00 70 01 03 20 02 80 03 12",
        ),
    ],
    ids=["ping", "read", "write", "factory reset", "sync write"],
)
def test_the_manuals_instructions(packet, example):
    assert packet.hex(" ") == example


def test_the_manuals_status_packets():
    assert parsed(bytes.fromhex("ff ff 01 02 00 fc")) == Status(1, 0, b"")
    assert parsed(bytes.fromhex("ff ff 01 03 00 20 db")) == Status(1, 0, b"\x20")
    error = parsed(bytes.fromhex("ff ff 01 02 24 d8"))
    assert StatusError(error.error) == StatusError.OVERHEATING | StatusError.OVERLOAD
    assert parsed(p1.read_range(5, 36, 6)) == Status(5, 2, bytes((36, 6))), "an echo parses as a status"


@given(ids, st.binary(max_size=40), st.integers(0, 255), st.data())
@settings(max_examples=100, deadline=None)
def test_a_status_comes_back_as_it_was_made_and_one_changed_byte_is_noticed(servo_id, data, error, chance):
    packet = bytearray(p1.status_packet(servo_id, error, data))
    assert parsed(packet) == Status(servo_id, error, data)
    packet[chance.draw(st.integers(0, len(packet) - 1))] ^= chance.draw(st.integers(1, 255))
    assert parsed(packet) is None


def test_the_error_byte_in_words():
    assert p1.describe_error(0) == "no error"
    words = "voltage", "angle limit", "overheating", "range", "checksum", "overload", "instruction", "bit 7"
    assert [word for word in words if word not in p1.describe_error(0xFF)] == []


@pytest.mark.parametrize(
    "build",
    [
        lambda: p1.ping(255),
        lambda: p1.ping(-1),
        lambda: p1.write_range(1, 0, bytes(253)),
        lambda: p1.sync_write(30, 4, {1: b"\0\0"}),
        lambda: p1.sync_write(30, 4, {1: bytes(5), 2: bytes(4)}),
        lambda: p1.sync_write(30, 4, {i: bytes(4) for i in range(51)}),
    ],
)
def test_what_cannot_be_said_is_refused(build):
    with pytest.raises(ValueError, match=r"not an ID|fit|instead of"):
        build()


def test_an_error_bit_is_a_refusal_only_where_data_are_missing():
    for bit in StatusError:
        refusal = bit in {StatusError.RANGE, StatusError.CHECKSUM, StatusError.INSTRUCTION}
        assert p1.refused(bit, 0, 2) == refusal
        assert not p1.refused(bit, 2, 2)
        assert not p1.refused(bit, 0, 0), "an acknowledgement: the read-back decides"


def test_a_status_reads_as_an_instruction_only_where_code_and_length_are_one():
    sent = p1.ping(1), p1.read_range(1, 36, 2), p1.write_range(1, 30, b"\0"), p1.factory_reset(1)
    assert all(p1.instructs(memoryview(packet)) for packet in sent)
    for error, length in ((1, 1), (2, 1), (2, 3), (3, 1), (7, 2)):
        assert not p1.instructs(memoryview(p1.status_packet(1, error, bytes(length))))


def test_a_header_is_one_of_an_id_and_of_two_bytes_at_least_behind_its_length():
    for head, size in (((5, 1), -1), ((5, 2), 6), ((5, 0xFF), p1.LONGEST), ((0xFF, 2), -1)):
        packet = p1.HEADER + bytes(head)
        assert p1.size_at(packet, 0, len(packet)) == size
