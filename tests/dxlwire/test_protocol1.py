import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlwire.wire import protocol1
from dxlwire.wire.protocol1 import Status, StatusError

ids = st.integers(0, protocol1.HIGHEST_ID)


def parsed(packet):
    """Return the status of a whole packet; None: header, length or checksum are wrong."""
    view = memoryview(bytes(packet))
    whole = packet.startswith(protocol1.HEADER) and protocol1.size_at(view, 0, len(view)) == len(view)
    return protocol1.opened(view) if whole and protocol1.intact(view) else None


def test_the_manuals_instruction_packets():
    assert protocol1.ping(1).hex(" ") == "ff ff 01 02 01 fb"
    assert protocol1.read_range(1, 0x2B, 1).hex(" ") == "ff ff 01 04 02 2b 01 cc"
    assert protocol1.write_range(0xFE, 3, b"\x01").hex(" ") == "ff ff fe 04 03 03 01 f6"
    assert protocol1.factory_reset(0).hex(" ") == "ff ff 00 02 06 f7"


def test_the_manuals_sync_write():
    goals = {
        0: bytes.fromhex("10 00 50 01"),
        1: bytes.fromhex("20 02 60 03"),
        2: bytes.fromhex("30 00 70 01"),
        3: bytes.fromhex("20 02 80 03"),
    }
    assert protocol1.sync_write(30, 4, goals).hex(" ") == (
        "ff ff fe 18 83 1e 04 00 10 00 50 01 01 20 02 60 03 02 30 00 70 01 03 20 02 80 03 12"
    )


def test_the_manuals_status_packets():
    assert parsed(bytes.fromhex("ff ff 01 02 00 fc")) == Status(1, 0, b"")
    assert parsed(bytes.fromhex("ff ff 01 03 00 20 db")) == Status(1, 0, b"\x20")
    error = parsed(bytes.fromhex("ff ff 01 02 24 d8"))
    assert StatusError(error.error) == StatusError.OVERHEATING | StatusError.OVERLOAD


@given(ids, st.binary(max_size=40), st.integers(0, 255))
@settings(max_examples=100, deadline=None)
def test_a_status_comes_back_as_it_was_made(servo_id, parameters, error):
    packet = protocol1.status_packet(servo_id, error, parameters)
    assert parsed(packet) == Status(servo_id, error, parameters)


@given(ids, st.binary(max_size=20), st.data())
@settings(max_examples=100, deadline=None)
def test_one_changed_byte_is_always_noticed(servo_id, parameters, data):
    packet = bytearray(protocol1.status_packet(servo_id, 0, parameters))
    packet[data.draw(st.integers(0, len(packet) - 1))] ^= data.draw(st.integers(1, 255))
    assert parsed(packet) is None


def test_an_echoed_instruction_parses_as_a_status():
    assert parsed(protocol1.read_range(5, 36, 6)) == Status(5, 2, bytes((36, 6)))


def test_the_error_byte_in_words():
    assert protocol1.describe_error(0) == "no error"
    words = protocol1.describe_error(0xFF)
    for bit in (
        "voltage",
        "angle limit",
        "overheating",
        "range",
        "checksum",
        "overload",
        "instruction",
        "bit 7",
    ):
        assert bit in words


@pytest.mark.parametrize(
    "build",
    [
        lambda: protocol1.ping(255),
        lambda: protocol1.ping(-1),
        lambda: protocol1.write_range(1, 0, bytes(253)),
        lambda: protocol1.sync_write(30, 4, {1: b"\0\0"}),
        lambda: protocol1.sync_write(30, 4, {1: bytes(5), 2: bytes(4)}),
        lambda: protocol1.sync_write(30, 4, {i: bytes(4) for i in range(51)}),
    ],
)
def test_what_cannot_be_said_is_refused(build):
    with pytest.raises(ValueError, match=r"not an ID|fit|instead of"):
        build()


def test_an_error_bit_is_a_refusal_only_where_data_are_missing():
    for bit in StatusError:
        refusal = bit in {StatusError.RANGE, StatusError.CHECKSUM, StatusError.INSTRUCTION}
        assert protocol1.refused(bit, 0, 2) == refusal
        assert not protocol1.refused(bit, 2, 2)
        assert not protocol1.refused(bit, 0, 0), "an acknowledgement: the read-back decides"


def test_a_status_reads_as_an_instruction_only_where_code_and_length_are_one():
    for packet in (
        protocol1.ping(1),
        protocol1.read_range(1, 36, 2),
        protocol1.write_range(1, 30, b"\0"),
        protocol1.factory_reset(1),
    ):
        assert protocol1.instructs(memoryview(packet))
    for error, length in ((1, 1), (2, 1), (2, 3), (3, 1), (7, 2)):
        assert not protocol1.instructs(memoryview(protocol1.status_packet(1, error, bytes(length))))


def test_a_header_is_one_of_an_id_and_of_two_bytes_at_least_behind_its_length():
    for head, size in (((5, 1), -1), ((5, 2), 6), ((5, 0xFF), protocol1.LONGEST), ((0xFF, 2), -1)):
        packet = protocol1.HEADER + bytes(head)
        assert protocol1.size_at(packet, 0, len(packet)) == size
