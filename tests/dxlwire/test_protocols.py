"""Packets of both protocols: the e-Manual's own, what cannot be one, and how they are found among bytes."""

import pytest
from dynamixel_sdk import protocol2_packet_handler as sdk
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import fuzz_receiver
from dxlwire.wire import protocol1, protocol2
from dxlwire.wire import protocol1 as p1
from dxlwire.wire import protocol2 as p2
from dxlwire.wire.protocol1 import Status, StatusError
from dxlwire.wire.receiver import Receiver

GOALS = {0: b"\x10\0\x50\1", 1: b"\x20\2\x60\3", 2: b"\x30\0\x70\1", 3: b"\x20\2\x80\3"}
INSTRUCTIONS_1 = {
    "01 02 01 fb": p1.ping(1),
    "01 04 02 2b 01 cc": p1.read_range(1, 0x2B, 1),
    "fe 04 03 03 01 f6": p1.write_range(0xFE, 3, b"\x01"),
    "00 02 06 f7": p1.factory_reset(0),
    "fe 18 83 1e 04 00 10005001 01 20026003 02 30007001 03 20028003 12": p1.sync_write(30, 4, GOALS),
}


def parsed(packet, dialect=p1):
    """Return the status in a packet; None if a part of the packet is wrong, or if it has another type."""
    view = memoryview(bytes(packet))
    whole = packet.startswith(dialect.HEADER) and dialect.size_at(view, 0, len(view)) == len(view)
    return dialect.opened(view) if whole and dialect.intact(view) else None


def test_the_manuals_status_packets():
    assert parsed(bytes.fromhex("ff ff 01 02 00 fc")) == Status(1, 0, b"")
    assert parsed(bytes.fromhex("ff ff 01 03 00 20 db")) == Status(1, 0, b"\x20")
    error = parsed(bytes.fromhex("ff ff 01 02 24 d8"))
    assert StatusError(error.error) == StatusError.OVERHEATING | StatusError.OVERLOAD
    assert parsed(p1.read_range(5, 36, 6)) == Status(5, 2, bytes((36, 6))), "an echo parses as a status"


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


GOALS_2 = {1: b"\x96\0\0\0", 2: b"\xaa\0\0\0"}
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
    "FE 1100 83 74000400 0196000000 02AA000000 8287": p2.sync_write(116, 4, GOALS_2),
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
settings_2 = settings(max_examples=100, deadline=None)


def printed(example):
    return p2.HEADER + bytes.fromhex(example)


@pytest.mark.parametrize(
    ("dialect", "example"),
    [*((p1, example) for example in INSTRUCTIONS_1), *((p2, example) for example in INSTRUCTIONS)],
)
def test_the_manuals_instructions(dialect, example):
    assert (INSTRUCTIONS | INSTRUCTIONS_1)[example] == dialect.HEADER + bytes.fromhex(example)


@pytest.mark.parametrize("example", MISPRINTS)
def test_the_manuals_misprints_are_not_what_goes_over_the_line(example):
    packet, right = MISPRINTS[example]
    assert packet == printed(example)[:-2] + bytes.fromhex(right)
    assert not p2.intact(memoryview(printed(example)))
    assert p2.intact(memoryview(packet))


@pytest.mark.parametrize("example", STATUSES)
def test_the_manuals_statuses(example):
    status = STATUSES[example]
    assert parsed(printed(example), p2) == status
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
@settings_2
def test_crc_and_stuffing_are_what_the_sdk_would_do_if_it_kept_the_result(data, stuffed):
    handler = sdk.Protocol2PacketHandler()
    assert p2.crc(b"123456789") == 0xFEE8
    assert p2.crc(data) == handler.updateCRC(0, list(data), len(data))
    plain = [*p2.HEADER, 1, *(len(stuffed) + 3).to_bytes(2, "little"), 0x03, *stuffed, 0, 0]
    ours = p2.instruction_packet(1, p2.Protocol2Instruction.WRITE, stuffed)
    assert bytes(handler.addStuffing(plain))[:-2] == ours[:-2]
    assert p2.unstuffed(p2.stuffed(stuffed)) == stuffed


@pytest.mark.parametrize("dialect", [p1, p2])
@given(st.integers(0, 252), st.integers(0, 255), parameters, st.data())
@settings_2
def test_a_status_survives_the_line_and_one_changed_byte_is_noticed(dialect, servo_id, error, data, chance):
    packet = bytearray(dialect.status_packet(servo_id, error, data))
    assert parsed(packet, dialect) == (servo_id, error, data)
    assert dialect is p1 or p2.HEADER not in packet[4:-2]
    assert dialect is p1 or len(packet) <= p2.widest(len(data)) + 1  # FF FF FD may begin at INST
    packet[chance.draw(st.integers(0, len(packet) - 1))] ^= chance.draw(st.integers(1, 255))
    assert parsed(packet, dialect) is None


@pytest.mark.parametrize(
    ("dialect", "head", "size"),
    [
        (p1, (5, 1), -1),
        (p1, (5, 2), 6),
        (p1, (5, 0xFF), p1.LONGEST),
        (p1, (0xFF, 2), -1),
        (p2, (1, 2, 0), -1),
        (p2, (1, 3, 0), 10),
        (p2, (1, *(p2.LONGEST - 7).to_bytes(2, "little")), p2.LONGEST),
        (p2, (1, *(p2.LONGEST - 6).to_bytes(2, "little")), -1),
    ],
)
def test_a_header_has_an_id_and_announces_what_a_packet_can_have(dialect, head, size):
    packet = dialect.HEADER + bytes(head)
    assert dialect.size_at(packet, 0, len(packet)) == size


@pytest.mark.parametrize("length", range(8))
def test_no_status_is_wider_than_its_widest(length):
    data = (b"\xff\xfd\xff" * 3)[:length]
    assert len(p2.status_packet(1, 0xFF, data)) <= p2.widest(length)


def test_a_status_that_is_none():
    good = p2.status_packet(1, 0, b"\1\2")
    for wrong in (good[:-1], good[:-1] + b"\0", b"\xff" + good, p2.ping(1) + b"\0", p2.read_range(1, 0, 2)):
        assert parsed(wrong, p2) is None
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


class Heard:
    """Everything a receiver delivered, in order."""

    def __init__(self, dialect=protocol1):
        self.parts = []
        self.receiver = Receiver(self.taker("packet"), self.taker("noise"), dialect)

    def taker(self, kind):
        return lambda data, first, last: self.parts.append((kind, bytes(data), first, last))

    def feed(self, *pieces):
        """Feed pieces, one every 10 ns."""
        for number, data in enumerate(pieces, 1):
            self.receiver.feed_bytes(data, 10 * number)
        return self

    def flush(self):
        self.receiver.flush()
        return self

    @property
    def packets(self):
        return [data for kind, data, _, _ in self.parts if kind == "packet"]

    @property
    def all_bytes(self):
        return b"".join(data for _, data, _, _ in self.parts)


header_bytes = st.lists(st.sampled_from([0xFF, 0xFF, 0xFD, 0xFD, 0x00, 0x55]), max_size=20).map(bytes)
any_bytes = header_bytes | st.binary(max_size=30)
both = pytest.mark.parametrize("dialect", [protocol1, protocol2], ids=["protocol 1", "protocol 2"])
often = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
statuses = st.tuples(st.integers(0, 252), st.integers(0, 255), header_bytes | st.binary(max_size=20))


def quiet(noise, dialect):
    """Return noise without a header of a protocol."""
    if dialect is protocol1:
        return noise.replace(b"\xff", b"\xfe")
    return noise.replace(b"\xfd\x00", b"\xfd\x01")


def cut(stream, cuts):
    ends = sorted({min(each, len(stream)) for each in cuts} | {len(stream)})
    return [stream[start:end] for start, end in zip([0, *ends], ends, strict=False)]


@both
@often
@given(
    parts=st.lists(st.tuples(any_bytes, statuses), max_size=8),
    cuts=st.lists(st.integers(0, 300), max_size=20),
)
def test_every_intact_packet_between_noise_is_delivered_once_however_it_is_split(dialect, parts, cuts):
    packets = [dialect.status_packet(*status) for _, status in parts]
    noises = [quiet(noise, dialect) for noise, _ in parts]
    stream = b"".join(noise + packet for noise, packet in zip(noises, packets, strict=True))
    heard = Heard(dialect).feed(*cut(stream, cuts))
    assert heard.packets == packets
    assert heard.all_bytes == stream
    assert heard.receiver.pending == 0


@both
@often
@given(stream=header_bytes | st.binary(max_size=600), cuts=st.lists(st.integers(0, 600), max_size=20))
def test_any_bytes_leave_once_and_in_order(dialect, stream, cuts):
    whole, pieces = Heard(dialect).feed(stream), Heard(dialect).feed(*cut(stream, cuts))
    assert pieces.packets == whole.packets
    assert max(whole.receiver.pending, pieces.receiver.pending) < dialect.LONGEST
    assert whole.flush().all_bytes == pieces.flush().all_bytes == stream


@both
@often
@given(status=statuses, noise=any_bytes)
def test_flush_finds_the_packet_behind_any_unfinished_header(dialect, status, noise):
    packet = dialect.status_packet(*status)
    heard = Heard(dialect).feed(noise + packet).flush()
    assert heard.all_bytes == noise + packet
    # a false packet that swallows the real one with a right checksum is possible and legal
    assert heard.packets == [packet] or any(found != packet for found in heard.packets)


ONE = protocol1.status_packet(1, 0, b"\1\2")


def test_times_are_those_of_the_reads_that_brought_first_and_last_byte():
    two = protocol1.status_packet(2)
    heard = Heard().feed(ONE[:3], ONE[3:5], ONE[5:] + two[:2], two[2:])
    assert heard.parts == [("packet", ONE, 10, 30), ("packet", two, 30, 40)]


def test_a_packet_behind_a_false_header_is_found_with_the_times_of_its_own_reads():
    false = b"\xff\xff\x05\x05\0\0"  # ends within the true one, which begins with a read()
    assert Heard().feed(false, ONE).parts == [("noise", false, 10, 10), ("packet", ONE, 20, 20)]
    third = b"\xff" + ONE  # a third ff before a packet is noise
    assert Heard().feed(third).parts == [("noise", b"\xff", 10, 10), ("packet", ONE, 10, 10)]


def test_a_header_that_announces_more_than_anybody_says_holds_nothing_back():
    packet = protocol2.status_packet(1, 0, b"\x20")
    assert Heard(protocol2).feed(protocol2.HEADER + b"\x01\xff\xff" + packet).packets == [packet]


def test_a_status_of_a_fast_form_is_framed_by_its_length_alone():
    # servo 3 has FF FF FD 00 in its data, and fast forms are not stuffed
    packet = protocol2.HEADER + bytes((254, 1 + 2 * 8, 0, 0x55))
    for part in (bytes((0, 3)) + protocol2.HEADER, bytes((0, 4)) + bytes(4)):
        packet += part
        packet += protocol2.crc(packet).to_bytes(2, "little")
    heard = Heard(protocol2).feed(packet + protocol2.status_packet(5))
    assert heard.packets == [packet, protocol2.status_packet(5)]
    assert protocol2.fast_answers(packet, (4, 4)) == [(3, 0, protocol2.HEADER), (4, 0, bytes(4))]


@both
def test_a_sample_of_the_campaign(dialect):
    """Of bench/fuzz_receiver.py; the whole of it has 1,000,000 packets."""
    tally = fuzz_receiver.campaign(dialect, 3_000, seed=7)
    assert tally.packets == 3_000
    assert tally.intact - tally.swallowed + tally.accidents == tally.delivered
    assert tally.swallowed < tally.intact // 100
    assert tally.most_pending < dialect.LONGEST
