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
        self.receiver = Receiver(self._taker("packet"), self._taker("noise"), dialect)

    def _taker(self, kind):
        return lambda data, first, last: self.parts.append((kind, bytes(data), first, last))

    @property
    def packets(self):
        return [data for kind, data, _, _ in self.parts if kind == "packet"]

    @property
    def all_bytes(self):
        return b"".join(data for _, data, _, _ in self.parts)


ID = {protocol1: 253, protocol2: 252}
header_bytes = st.lists(st.sampled_from([0xFF, 0xFF, 0xFD, 0xFD, 0x00, 0x55]), max_size=20).map(bytes)
any_bytes = header_bytes | st.binary(max_size=30)
both = pytest.mark.parametrize("dialect", [protocol1, protocol2], ids=["protocol 1", "protocol 2"])
often = settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def draw_packet(data, dialect):
    servo_id, error = data.draw(st.integers(0, ID[dialect])), data.draw(st.integers(0, 255))
    return dialect.status_packet(servo_id, error, data.draw(any_bytes)[:20])


def quiet(noise, dialect):
    """Return noise without a header of a protocol."""
    if dialect is protocol1:
        return noise.replace(b"\xff", b"\xfe")
    return noise.replace(b"\xfd\x00", b"\xfd\x01")


def feed_in_pieces(receiver, stream, cuts):
    ends = sorted({min(cut, len(stream)) for cut in cuts} | {len(stream)})
    start = 0
    for time, end in enumerate(ends):
        receiver.feed_bytes(stream[start:end], time)
        start = end


@both
@often
@given(
    data=st.data(), noises=st.lists(any_bytes, max_size=8), cuts=st.lists(st.integers(0, 300), max_size=20)
)
def test_every_intact_packet_between_noise_is_delivered_once_however_it_is_split(dialect, data, noises, cuts):
    parts = [(quiet(noise, dialect), draw_packet(data, dialect)) for noise in noises]
    stream = b"".join(noise + packet for noise, packet in parts)
    heard = Heard(dialect)
    feed_in_pieces(heard.receiver, stream, cuts)
    assert heard.packets == [packet for _, packet in parts]
    assert heard.all_bytes == stream
    assert heard.receiver.pending == 0


@both
@often
@given(stream=header_bytes | st.binary(max_size=600), cuts=st.lists(st.integers(0, 600), max_size=20))
def test_any_bytes_leave_once_and_in_order(dialect, stream, cuts):
    whole, pieces = Heard(dialect), Heard(dialect)
    whole.receiver.feed_bytes(stream, 0)
    feed_in_pieces(pieces.receiver, stream, cuts)
    assert pieces.packets == whole.packets
    whole.receiver.flush()
    pieces.receiver.flush()
    assert whole.all_bytes == pieces.all_bytes == stream


@both
@often
@given(data=st.data(), noise=any_bytes)
def test_flush_finds_the_packet_behind_any_unfinished_header(dialect, data, noise):
    packet = draw_packet(data, dialect)
    heard = Heard(dialect)
    heard.receiver.feed_bytes(noise + packet, 0)
    heard.receiver.flush()
    assert heard.all_bytes == noise + packet
    # a false packet that swallows the real one with a right checksum is possible and legal
    assert heard.packets == [packet] or any(found != packet for found in heard.packets)


@both
@often
@given(data=st.data(), count=st.integers(2, 6))
def test_a_mutated_byte_spoils_no_packet_before_it_and_stays_visible(dialect, data, count):
    packets = [draw_packet(data, dialect) for _ in range(count)]
    victim = data.draw(st.integers(0, count - 1))
    broken = bytearray(packets[victim])
    broken[data.draw(st.integers(2, len(broken) - 1))] ^= 1 << data.draw(st.integers(0, 6))
    stream = b"".join([*packets[:victim], bytes(broken), *packets[victim + 1 :]])
    heard = Heard(dialect)
    heard.receiver.feed_bytes(stream, 0)
    heard.receiver.flush()
    assert heard.all_bytes == stream
    assert heard.packets[:victim] == packets[:victim]


def test_a_long_false_header_holds_packets_back_until_flush():
    packet = protocol1.status_packet(1, 0, b"\x20")
    heard = Heard()
    heard.receiver.feed_bytes(b"\xff\xff\x05\xf0" + packet, 0)
    assert heard.packets == []
    heard.receiver.flush()
    assert heard.packets == [packet]
    assert heard.all_bytes == b"\xff\xff\x05\xf0" + packet


def test_a_packet_behind_a_false_header_is_found_with_the_times_of_its_own_reads():
    """The false one ends within the true one, which begins with a read()."""
    packet, false = protocol1.status_packet(1, 0, b"\x20"), b"\xff\xff\x05\x05\0\0"
    heard = Heard()
    heard.receiver.feed_bytes(false, 10)
    heard.receiver.feed_bytes(packet, 20)
    assert heard.parts == [("noise", false, 10, 10), ("packet", packet, 20, 20)]


def test_a_third_ff_before_a_packet_is_noise():
    packet = protocol1.status_packet(1)
    heard = Heard()
    heard.receiver.feed_bytes(b"\xff" + packet, 0)
    assert heard.parts == [("noise", b"\xff", 0, 0), ("packet", packet, 0, 0)]


def test_times_are_those_of_the_reads_that_brought_first_and_last_byte():
    one, two = protocol1.status_packet(1, 0, b"\1\2"), protocol1.status_packet(2)
    heard = Heard()
    heard.receiver.feed_bytes(one[:3], 10)
    heard.receiver.feed_bytes(one[3:5], 20)
    heard.receiver.feed_bytes(one[5:] + two[:2], 30)
    heard.receiver.feed_bytes(two[2:], 40)
    assert heard.parts == [("packet", one, 10, 30), ("packet", two, 30, 40)]


def test_memory_is_bounded_and_nothing_is_lost_in_a_flood():
    heard = Heard()
    stream = (b"\xff\xff\x01\xff" + bytes(300)) * 40
    heard.receiver.feed_bytes(stream, 0)
    assert heard.receiver.pending < protocol1.LONGEST
    heard.receiver.flush()
    assert heard.all_bytes == stream


def test_a_status_of_a_fast_form_is_framed_by_its_length_alone():
    # servo 3 has FF FF FD 00 in its data, and fast forms are not stuffed
    body = protocol2.HEADER + bytes((254, 1 + 2 * 8, 0, 0x55)) + bytes((0, 3)) + protocol2.HEADER
    body += protocol2.crc(body).to_bytes(2, "little") + bytes((0, 4)) + bytes(4)
    packet = body + protocol2.crc(body).to_bytes(2, "little")
    heard = Heard(protocol2)
    heard.receiver.feed_bytes(packet + protocol2.status_packet(5), 0)
    assert heard.packets == [packet, protocol2.status_packet(5)]
    assert protocol2.fast_answers(packet, (4, 4)) == [(3, 0, protocol2.HEADER), (4, 0, bytes(4))]


def test_a_header_that_announces_more_than_anybody_says_holds_nothing_back():
    packet = protocol2.status_packet(1, 0, b"\x20")
    heard = Heard(protocol2)
    heard.receiver.feed_bytes(protocol2.HEADER + b"\x01\xff\xff" + packet, 0)
    assert heard.packets == [packet]


@both
def test_a_sample_of_the_campaign(dialect):
    """Of bench/fuzz_receiver.py; the whole of it has 1,000,000 packets."""
    tally = fuzz_receiver.campaign(dialect, 3_000, seed=7)
    assert tally.packets == 3_000
    assert tally.intact - tally.swallowed + tally.accidents == tally.delivered
    assert tally.swallowed < tally.intact // 100
    assert tally.most_pending < dialect.LONGEST
