"""Golden vectors: the examples of the e-Manual, "DYNAMIXEL Protocol 2.0", and two of its misprints."""

import pytest
from dynamixel_sdk import protocol2_packet_handler as sdk
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlwire.wire import protocol2 as p2

GOALS = {1: b"\x96\0\0\0", 2: b"\xaa\0\0\0"}
BULK = [(3, 132, 4), (7, 124, 2), (4, 146, 1)]
INSTRUCTIONS = {  # ID, length, instruction and parameters, CRC
    "01 0300 01 194E": p2.ping(1),
    "FE 0300 01 3142": p2.ping(),
    "01 0700 02 84000400 1D15": p2.read_range(1, 132, 4),
    "01 0900 03 740000020000 CA89": p2.write_range(1, 116, b"\0\2\0\0"),
    "01 0400 06 01 A1E6": p2.factory_reset(1, p2.Reset.KEEP_ID),
    "01 0300 08 2F4E": p2.reboot(1),
    "01 0800 20 014354524C 16F5": p2.back_up(1),
    "FE 0900 82 84000400 0102 CEFA": p2.sync_read(132, 4, (1, 2)),
    "FE 1100 83 74000400 0196000000 02AA000000 8287": p2.sync_write(116, 4, GOALS),
    "FE 0D00 92 0190000200 0292000100 1A05": p2.bulk_read([(1, 144, 2), (2, 146, 1)]),
    "FE 0A00 8A 84000400 030704 20F2": p2.sync_read(132, 4, (3, 7, 4), fast=True),
    "FE 0900 8A 44020400 0102 72F2": p2.sync_read(0x244, 4, (1, 2), fast=True),
}
MISPRINTS = {  # the example in the manual: packet, the CRC that is right
    "FE 1200 9A 0384000400 077C000200 0492000100 20F2": (p2.bulk_read(BULK, fast=True), "DA 2D"),
    "01 0800 20 024354524C 92F5": (p2.restore(1), "9E F5"),
}
STATUSES = {
    "01 0700 55 00 060426 655D": p2.Status(1, 0, b"\x06\x04\x26"),
    "02 0700 55 00 060426 6F6D": p2.Status(2, 0, b"\x06\x04\x26"),
    "01 0800 55 00 A6000000 8CC0": p2.Status(1, 0, b"\xa6\0\0\0"),
    "02 0800 55 00 1F080000 BABE": p2.Status(2, 0, b"\x1f\x08\0\0"),
    "01 0400 55 00 A10C": p2.Status(1, 0, b""),
    "01 0600 55 00 7700 C369": p2.Status(1, 0, b"\x77\0"),
    "02 0500 55 00 24 8BA9": p2.Status(2, 0, b"\x24"),
}
FAST_SYNC = bytes.fromhex(
    "FFFFFD00FE1900550003A6000000840800071F08000016CA0004FF030000D19E"  # ID 3, 7 and 4, four bytes each
)
FAST_BULK = bytes.fromhex("FFFFFD00FE1400550003A600000067A40007A501247400041FD9C1")
# many bytes of the header's kind, so that stuffing matters
LIKE_HEADERS = st.lists(st.sampled_from([0xFF, 0xFF, 0xFD, 0x00, 0x55, 0x01]), max_size=40).map(bytes)
parameters = LIKE_HEADERS | st.binary(max_size=40)
often = settings(max_examples=100, deadline=None)


def printed(example):
    return p2.HEADER + bytes.fromhex(example)


def parsed(packet):
    """Return the status of a whole packet; None: it is an instruction, or length or CRC are wrong."""
    view = memoryview(packet)
    whole = packet.startswith(p2.HEADER) and p2.size_at(view, 0, len(view)) == len(view)
    return p2.opened(view) if whole and p2.intact(view) else None


@pytest.mark.parametrize("example", INSTRUCTIONS)
def test_the_manuals_instructions(example):
    assert INSTRUCTIONS[example] == printed(example)


@pytest.mark.parametrize("example", MISPRINTS)
def test_the_manuals_misprints_are_not_what_goes_over_the_line(example):
    packet, right = MISPRINTS[example]
    assert packet == printed(example)[:-2] + bytes.fromhex(right)
    assert not p2.intact(memoryview(printed(example)))
    assert p2.intact(memoryview(packet))


@pytest.mark.parametrize("example", STATUSES)
def test_the_manuals_statuses(example):
    status = STATUSES[example]
    assert parsed(printed(example)) == status
    assert p2.status_packet(status.servo_id, status.error, bytes(status.parameters)) == printed(example)


def test_the_manuals_statuses_of_the_fast_forms():
    found = [(3, 0, b"\xa6\0\0\0"), (7, 0, b"\x1f\x08\0\0"), (4, 0, b"\xff\x03\0\0")]
    assert p2.fast_answers(FAST_SYNC, (4, 4, 4)) == found
    found = [(3, 0, b"\xa6\0\0\0"), (7, 0, b"\xa5\x01"), (4, 0, b"\x1f")]
    assert p2.fast_answers(FAST_BULK, (4, 2, 1)) == found
    assert p2.intact(memoryview(FAST_SYNC))
    assert p2.intact(memoryview(FAST_BULK))


def test_what_came_before_an_absent_servo_can_be_used():
    broken = FAST_SYNC[:18] + bytes((FAST_SYNC[18] ^ 1,)) + FAST_SYNC[19:]
    for packet, ids in ((FAST_SYNC[:24], [3, 7]), (FAST_SYNC[:23], [3]), (broken, [3])):
        assert [one.servo_id for one in p2.fast_answers(packet, (4, 4, 4))] == ids
    for wrong in (p2.status_packet(1), p2.sync_read(126, 10, (1, 2))):
        with pytest.raises(ValueError, match="fast read"):
            p2.fast_answers(wrong, (4,))


@given(st.binary(max_size=60), parameters)
@often
def test_crc_and_stuffing_are_what_the_sdk_would_do_if_it_kept_the_result(data, stuffed):
    handler = sdk.Protocol2PacketHandler()
    assert p2.crc(b"123456789") == 0xFEE8
    assert p2.crc(data) == handler.updateCRC(0, list(data), len(data))
    plain = [*p2.HEADER, 1, *(len(stuffed) + 3).to_bytes(2, "little"), 0x03, *stuffed, 0, 0]
    ours = p2.instruction_packet(1, p2.Protocol2Instruction.WRITE, stuffed)
    assert bytes(handler.addStuffing(plain))[:-2] == ours[:-2]
    assert p2.unstuffed(p2.stuffed(stuffed)) == stuffed


@given(st.integers(0, 252), st.integers(0, 255), parameters)
@often
def test_a_status_survives_the_line(servo_id, error, data):
    packet = p2.status_packet(servo_id, error, data)
    assert parsed(packet) == (servo_id, error, data)
    assert b"\xff\xff\xfd\x00" not in packet[4:-2]
    assert p2.size_at(packet, 0, len(packet)) == len(packet)
    assert len(packet) <= p2.widest(len(data)) + 1  # FF FF FD may begin at INST


def test_a_header_announces_at_most_the_longest_packet():
    for size, taken in ((9, -1), (10, 10), (p2.LONGEST, p2.LONGEST), (p2.LONGEST + 1, -1)):
        packet = p2.HEADER + b"\x01" + (size - 7).to_bytes(2, "little")
        assert p2.size_at(packet, 0, len(packet)) == taken


@pytest.mark.parametrize("length", range(8))
def test_no_status_is_wider_than_its_widest(length):
    data = (b"\xff\xfd\xff" * 3)[:length]
    assert len(p2.status_packet(1, 0xFF, data)) <= p2.widest(length)


def test_a_status_that_is_none():
    good = p2.status_packet(1, 0, b"\1\2")
    for wrong in (good[:-1], good[:-1] + b"\0", b"\xff" + good, p2.ping(1) + b"\0", p2.read_range(1, 0, 2)):
        assert parsed(wrong) is None
    assert p2.opened(memoryview(p2.instruction_packet(1, p2.STATUS))) is None, "it has no error byte"


@pytest.mark.parametrize("servo_id", [253, 255, -1, 300])
def test_ids_that_could_be_taken_for_a_header_are_refused(servo_id):
    with pytest.raises(ValueError, match="not an ID"):
        p2.ping(servo_id)


def test_an_error_number_is_a_refusal_and_the_alert_bit_alone_is_not():
    cases = ((0x80, 4, False), (0x87, 0, True), (0x07, 4, True), (0x07, 3, False))
    assert [p2.refused(error, length, 4) for error, length, _ in cases] == [refused for *_, refused in cases]
    assert p2.refused(0x07, 0, 0)
    assert "alert" in p2.describe_error(0x80)
    assert p2.describe_error(0x84) == f"{p2.describe_error(0x80)}; {p2.describe_error(4)}"
    assert p2.describe_error(0) == "no error"


def test_reads_of_several_servos_take_the_shorter_packet():
    assert p2.read_many([(1, 126, 10), (2, 126, 10)]) == p2.sync_read(126, 10, (1, 2))
    for other in ((2, 37, 6), (2, 126, 6), (2, 37, 10)):
        assert p2.read_many([(1, 126, 10), other]) == p2.bulk_read([(1, 126, 10), other])
