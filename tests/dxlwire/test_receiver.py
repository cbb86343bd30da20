"""Packets among noise, whatever the pieces in which they come: each once, in order, with its times."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import fuzz_receiver
from dxlwire.wire import protocol1, protocol2
from dxlwire.wire.receiver import Receiver


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


def test_memory_is_bounded_and_nothing_is_lost_in_a_flood():
    stream = (b"\xff\xff\x01\xff" + bytes(300)) * 40
    heard = Heard().feed(stream)
    assert heard.receiver.pending < protocol1.LONGEST
    assert heard.flush().all_bytes == stream


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
