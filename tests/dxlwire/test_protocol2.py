"""Golden vectors: the examples of the e-Manual, "DYNAMIXEL Protocol 2.0", and two of its misprints."""

import pytest
from dynamixel_sdk import protocol2_packet_handler as sdk
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlwire.wire import protocol2 as p2

INSTRUCTIONS = {
    "ping": (p2.ping(1), "FF FF FD 00 01 03 00 01 19 4E"),
    "broadcast ping": (p2.ping(), "FF FF FD 00 FE 03 00 01 31 42"),
    "read": (p2.read_range(1, 132, 4), "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15"),
    "write": (p2.write_range(1, 116, b"\0\2\0\0"), "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89"),
    "factory reset": (p2.factory_reset(1, p2.Reset.KEEP_ID), "FF FF FD 00 01 04 00 06 01 A1 E6"),
    "reboot": (p2.reboot(1), "FF FF FD 00 01 03 00 08 2F 4E"),
    "back up": (p2.back_up(1), "FF FF FD 00 01 08 00 20 01 43 54 52 4C 16 F5"),
    "sync read": (p2.sync_read(132, 4, (1, 2)), "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA"),
    "sync write": (
        p2.sync_write(116, 4, {1: b"\x96\0\0\0", 2: b"\xaa\0\0\0"}),
        "FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87",
    ),
    "bulk read": (
        p2.bulk_read([(1, 144, 2), (2, 146, 1)]),
        "FF FF FD 00 FE 0D 00 92 01 90 00 02 00 02 92 00 01 00 1A 05",
    ),
    "fast sync read": (
        p2.sync_read(132, 4, (3, 7, 4), fast=True),
        "FF FF FD 00 FE 0A 00 8A 84 00 04 00 03 07 04 20 F2",
    ),
    "fast sync read of two": (
        p2.sync_read(0x244, 4, (1, 2), fast=True),
        "FF FF FD 00 FE 09 00 8A 44 02 04 00 01 02 72 F2",
    ),
}
MISPRINTS = {  # packet, its example in the manual, the CRC that is right
    "fast bulk read": (
        p2.bulk_read([(3, 132, 4), (7, 124, 2), (4, 146, 1)], fast=True),
        "FF FF FD 00 FE 12 00 9A 03 84 00 04 00 07 7C 00 02 00 04 92 00 01 00 20 F2",
        "DA 2D",
    ),
    "restore": (p2.restore(1), "FF FF FD 00 01 08 00 20 02 43 54 52 4C 92 F5", "9E F5"),
}
STATUSES = {
    "ping": ("FF FF FD 00 01 07 00 55 00 06 04 26 65 5D", p2.Status(1, 0, b"\x06\x04\x26")),
    "ping of ID 2": ("FF FF FD 00 02 07 00 55 00 06 04 26 6F 6D", p2.Status(2, 0, b"\x06\x04\x26")),
    "read": ("FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0", p2.Status(1, 0, b"\xa6\0\0\0")),
    "read of ID 2": ("FF FF FD 00 02 08 00 55 00 1F 08 00 00 BA BE", p2.Status(2, 0, b"\x1f\x08\0\0")),
    "write": ("FF FF FD 00 01 04 00 55 00 A1 0C", p2.Status(1, 0, b"")),
    "bulk read, ID 1": ("FF FF FD 00 01 06 00 55 00 77 00 C3 69", p2.Status(1, 0, b"\x77\0")),
    "bulk read, ID 2": ("FF FF FD 00 02 05 00 55 00 24 8B A9", p2.Status(2, 0, b"\x24")),
}
FAST_SYNC = bytes.fromhex(
    "FFFFFD00FE1900550003A6000000840800071F08000016CA0004FF030000D19E"  # ID 3, 7 and 4, four bytes each
)
FAST_BULK = bytes.fromhex("FFFFFD00FE1400550003A600000067A40007A501247400041FD9C1")
# many bytes of the header's kind, so that stuffing matters
parameters = st.lists(st.sampled_from([0xFF, 0xFF, 0xFD, 0x00, 0x55, 0x01]), max_size=40).map(
    bytes
) | st.binary(max_size=40)


def parsed(packet):
    """Return the status of a whole packet; None: it is an instruction, or length or CRC are wrong."""
    view = memoryview(packet)
    whole = packet.startswith(p2.HEADER) and p2.size_at(view, 0, len(view)) == len(view)
    return p2.opened(view) if whole and p2.intact(view) else None


@pytest.mark.parametrize("name", INSTRUCTIONS)
def test_the_manuals_instructions(name):
    packet, example = INSTRUCTIONS[name]
    assert packet == bytes.fromhex(example)


@pytest.mark.parametrize("name", MISPRINTS)
def test_the_manuals_misprints_are_not_what_goes_over_the_line(name):
    packet, example, right = MISPRINTS[name]
    assert packet[:-2] == bytes.fromhex(example)[:-2]
    assert packet[-2:] == bytes.fromhex(right)
    assert not p2.intact(memoryview(bytes.fromhex(example)))
    assert p2.intact(memoryview(packet))


@pytest.mark.parametrize("name", STATUSES)
def test_the_manuals_statuses(name):
    example, status = STATUSES[name]
    assert parsed(bytes.fromhex(example)) == status
    assert p2.status_packet(status.servo_id, status.error, bytes(status.parameters)) == bytes.fromhex(example)


def test_the_manuals_statuses_of_the_fast_forms():
    assert p2.fast_answers(FAST_SYNC, (4, 4, 4)) == [
        (3, 0, b"\xa6\0\0\0"),
        (7, 0, b"\x1f\x08\0\0"),
        (4, 0, b"\xff\x03\0\0"),
    ]
    assert p2.fast_answers(FAST_BULK, (4, 2, 1)) == [
        (3, 0, b"\xa6\0\0\0"),
        (7, 0, b"\xa5\x01"),
        (4, 0, b"\x1f"),
    ]
    assert p2.intact(memoryview(FAST_SYNC))
    assert p2.intact(memoryview(FAST_BULK))


def test_what_came_before_an_absent_servo_can_be_used():
    assert [one.servo_id for one in p2.fast_answers(FAST_SYNC[:24], (4, 4, 4))] == [3, 7]
    assert [one.servo_id for one in p2.fast_answers(FAST_SYNC[:23], (4, 4, 4))] == [3]
    broken = bytearray(FAST_SYNC)
    broken[18] ^= 1
    assert [one.servo_id for one in p2.fast_answers(broken, (4, 4, 4))] == [3]
    with pytest.raises(ValueError, match="fast read"):
        p2.fast_answers(p2.status_packet(1), (4,))
    with pytest.raises(ValueError, match="fast read"):
        p2.fast_answers(p2.sync_read(126, 10, (1, 2)), (4,))


def test_the_crc_of_the_known_check():
    assert p2.crc(b"123456789") == 0xFEE8


@given(st.binary(max_size=60))
@settings(max_examples=60, deadline=None)
def test_the_crc_of_the_sdk(data):
    handler = sdk.Protocol2PacketHandler()
    assert p2.crc(data) == handler.updateCRC(0, list(data), len(data))


@given(st.integers(0, 252), st.integers(0, 255), parameters)
@settings(max_examples=200, deadline=None)
def test_a_status_survives_the_line(servo_id, error, data):
    packet = p2.status_packet(servo_id, error, data)
    assert parsed(packet) == (servo_id, error, data)
    assert b"\xff\xff\xfd\x00" not in packet[4:-2]
    assert p2.size_at(packet, 0, len(packet)) == len(packet)
    assert len(packet) <= p2.widest(len(data)) + 1  # FF FF FD may begin at INST


@given(parameters)
@settings(max_examples=200, deadline=None)
def test_stuffing_is_what_the_sdk_would_do_if_it_kept_the_result(data):
    handler = sdk.Protocol2PacketHandler()
    plain = [*p2.HEADER, 1, *(len(data) + 3).to_bytes(2, "little"), 0x03, *data, 0, 0]
    ours = p2.instruction_packet(1, p2.Protocol2Instruction.WRITE, data)
    assert bytes(handler.addStuffing(plain))[:-2] == ours[:-2]
    assert p2.unstuffed(p2.stuffed(data)) == data


def test_a_header_announces_at_most_the_longest_packet():
    for size, taken in ((9, -1), (10, 10), (p2.LONGEST, p2.LONGEST), (p2.LONGEST + 1, -1)):
        packet = p2.HEADER + b"\x01" + (size - 7).to_bytes(2, "little")
        assert p2.size_at(packet, 0, len(packet)) == taken


def test_a_status_without_an_error_byte_is_none():
    assert p2.opened(memoryview(p2.instruction_packet(1, p2.STATUS))) is None


@pytest.mark.parametrize("length", range(8))
def test_no_status_is_wider_than_its_widest(length):
    data = (b"\xff\xfd\xff" * 3)[:length]
    assert len(p2.status_packet(1, 0xFF, data)) <= p2.widest(length)


def test_a_status_that_is_none():
    good = p2.status_packet(1, 0, b"\1\2")
    for wrong in (good[:-1], good[:-1] + b"\0", b"\xff" + good, p2.ping(1) + b"\0", p2.read_range(1, 0, 2)):
        assert parsed(wrong) is None


@pytest.mark.parametrize("servo_id", [253, 255, -1, 300])
def test_ids_that_could_be_taken_for_a_header_are_refused(servo_id):
    with pytest.raises(ValueError, match="not an ID"):
        p2.ping(servo_id)


def test_an_error_number_is_a_refusal_and_the_alert_bit_alone_is_not():
    assert not p2.refused(0x80, 4, 4)
    assert p2.refused(0x87, 0, 4)
    assert p2.refused(0x07, 0, 0)
    assert p2.refused(0x07, 4, 4)
    assert not p2.refused(0x07, 3, 4)
    assert "alert" in p2.describe_error(0x80)
    assert p2.describe_error(0x84) == f"{p2.describe_error(0x80)}; {p2.describe_error(4)}"
    assert p2.describe_error(0) == "no error"


def test_reads_of_several_servos_take_the_shorter_packet():
    assert p2.read_many([(1, 126, 10), (2, 126, 10)]) == p2.sync_read(126, 10, (1, 2))
    for other in ((2, 37, 6), (2, 126, 6), (2, 37, 10)):
        assert p2.read_many([(1, 126, 10), other]) == p2.bulk_read([(1, 126, 10), other])
