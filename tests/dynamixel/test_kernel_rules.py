"""What the compiled kernel takes for a reply, rule by rule; all else it leaves to the parser."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

import fuzz_kernel as fuzz
from dxlrun.errors import PortError
from dxlwire.packets import PacketKind
from dxlwire.wire import protocol1, protocol2

DATA = bytes((0, 2, 0, 0, 0, 0, 0, 2, 0, 0))
"""Of a servo: whatever its layout, its position is the same in each cycle, and in its range."""
AT_NS = 1_500_000
GOOD = [True] * 4
PLAIN = ["single reads", "bulk read", "sync read"]


class Line:
    """Four servos on one line, read by the kernel; a test alters what they answer in one cycle."""

    def __init__(self, name):
        plans, self.dialect = fuzz.robot(name, 1)
        self.side = fuzz.Side(plans)
        self.goals = np.full_like(self.side.goals.values, np.nan)
        self.head = self.dialect.OVERHEAD - self.dialect.CHECKSUM  # bytes in front of a reply's data
        self.calm()

    @property
    def line(self):
        return self.side.lines.ports[0]

    def replies(self, data=DATA, error=0):
        """Return the replies to each read of a cycle, as lists of packets."""
        reads = self.side.prepare()[0]
        found = []
        for read in reads:
            parts = [
                (one.servo_id, error, data[: one.length].ljust(one.length, b"\0")) for one in read.awaited
            ]
            if read.fast:
                found.append((read, [fast(parts)]))
            else:
                found.append((read, [self.dialect.status_packet(*one) for one in parts]))
        return found

    def cycle(self, replies=None, pieces=lambda packets: [(AT_NS, b"".join(packets))]):
        """Run a cycle; return whether the kernel read it to its end, and which states are valid."""
        given = [(read.packet, pieces(packets)) for read, packets in replies or self.replies()]
        self.given = b"".join(data for _, mine in given for _, data in mine)
        ended = self.side.ended
        self.side.cycle([given], self.goals)
        return self.side.ended > ended, self.side.states.valid.tolist()

    def calm(self):
        """Let every servo answer until the kernel reads again."""
        for _ in range(8):
            ended, valid = self.cycle()
        assert (ended, valid) == (True, GOOD)

    def heard(self):
        """Return all bytes that the log has of what came in the newest cycle."""
        return b"".join(one.data for one in self.side.log if one.kind is not PacketKind.INSTRUCTION)

    def altered(self, victim, alter):
        """Return the replies with that of one servo altered."""
        replies = self.replies()
        number, place = (victim, 0) if len(replies) > 1 else (0, victim)
        packets = replies[number][1]
        place = min(place, len(packets) - 1)  # a fast status has all of them
        packets[place] = alter(packets[place])
        return replies

    def spoil(self, victim, alter):
        """Alter a servo's reply, or the fast status: it is left to the parser. Return which states are valid;
        then all is as it was.
        """
        ended, valid = self.cycle(self.altered(victim, alter))
        assert not ended
        assert not valid[victim]
        assert self.heard() == self.given
        self.calm()
        return valid


def fast(parts, spoilt=-1):
    """Return a fast status; `spoilt`: a part with a wrong CRC, which those behind it cover as it is."""
    size = sum(len(data) + 4 for _, _, data in parts) + 1
    packet = protocol2.HEADER + b"\xfe" + size.to_bytes(2, "little") + b"\x55"
    for number, (servo_id, error, data) in enumerate(parts):
        packet += bytes((error, servo_id)) + data
        packet += (protocol2.crc(packet) ^ (number == spoilt)).to_bytes(2, "little")
    return packet


def without(victim):
    return [servo != victim for servo in range(4)]


def flipped(packet, at):
    return packet[:at] + bytes((packet[at] ^ 1,)) + packet[at + 1 :]


def resealed(dialect, packet):
    """Return a packet with the right checksum of what it is now."""
    if dialect is protocol1:
        return packet[:-1] + bytes((protocol1.checksum(packet[2:-1]),))
    return packet[:-2] + protocol2.crc(packet[:-2]).to_bytes(2, "little")


@pytest.fixture
def line(request):
    return Line(request.param)


every = pytest.mark.parametrize("line", [*PLAIN, "fast sync read"], indirect=True)
plain = pytest.mark.parametrize("line", PLAIN, indirect=True)
sync = pytest.mark.parametrize("line", ["sync read"], indirect=True)
fast_sync = pytest.mark.parametrize("line", ["fast sync read"], indirect=True)


@plain
@pytest.mark.parametrize("victim", [0, 1, 3])
def test_a_reply_with_a_flipped_bit_is_not_taken(line, victim):
    for at in range(len(line.replies()[0][1][0])):
        line.spoil(victim, lambda packet, at=at: flipped(packet, at))


@plain
@pytest.mark.parametrize("victim", [0, 3])
def test_each_byte_in_front_of_the_data_is_checked_beside_the_checksum(line, victim):
    """With the right checksum: header, ID, length and, in Protocol 2.0, the instruction byte."""
    for at in range(line.head - 1):
        line.spoil(victim, lambda packet, at=at: resealed(line.dialect, flipped(packet, at)))


@plain
@pytest.mark.parametrize("bit", range(8))
@pytest.mark.parametrize("data", [0, 255])  # so that each bit is 0 once, and 1
def test_each_bit_of_a_checksum_counts(line, bit, data):
    for place in range(1, 1 + line.dialect.CHECKSUM):

        def alter(packet, place=place):
            at = line.head + 2
            wrong = bytearray(resealed(line.dialect, packet[:at] + bytes((data,)) + packet[at + 1 :]))
            wrong[-place] ^= 1 << bit
            return bytes(wrong)

        line.spoil(1, alter)


@every
def test_a_reply_whose_last_byte_comes_alone_is_taken_with_its_time(line):
    replies = line.replies()
    read, packets = replies[0]
    first = len(packets[0]) if len(packets) > 1 else 2
    early_ns = (len(read.packet) + first) * line.side.hardware._buses[0].byte_ns

    def pieces(mine):
        """The first byte comes sooner than the whole reply could, the whole does not."""
        data = b"".join(mine)
        cuts = [(1, 1), (early_ns, first)] if mine is packets and len(packets) > 1 else [(1, 1)]
        ends = [0, *(end for _, end in cuts), len(data) - 1, len(data)]
        times = [*(at for at, _ in cuts), AT_NS, AT_NS + 7]
        return [(at, data[start:end]) for at, (start, end) in zip(times, pairwise(ends), strict=True)]

    assert line.cycle(replies, pieces) == (True, GOOD)
    log = line.side.log
    statuses = [one for one in log if one.kind is PacketKind.STATUS]
    asked = [one for one in log if one.kind is PacketKind.INSTRUCTION]
    assert statuses[-1].last_ns == asked[-1].last_ns + AT_NS + 7


@plain
def test_a_changed_error_byte_is_left_to_the_parser(line):
    error = 0x20 if line.dialect is protocol1 else 0x80

    def alter(packet):
        return resealed(line.dialect, packet[: line.head - 1] + bytes((error,)) + packet[line.head :])

    ended, valid = line.cycle(line.altered(1, alter))
    assert (ended, valid) == (False, GOOD)
    (servos,) = line.side.hardware._servos
    assert servos.reads.errors == [0, error, 0, 0]


@every
def test_the_data_may_be_anything_that_is_no_jump_and_the_checksum_is_that_of_it(line):
    for number in range(20):
        data = bytes((0, 2, number, 0, number, 3, 0, 2, 0, 0))
        assert line.cycle(line.replies(data)) == (True, GOOD)


@fast_sync
@pytest.mark.parametrize("victim", range(4))
def test_of_a_fast_status_each_part_has_a_crc_of_its_own(line, victim):
    valid = [servo < victim for servo in range(4)]

    def ends():
        size = line.replies()[0][0].awaited[0].length + 4
        return 8 + victim * size, 8 + (victim + 1) * size

    for at in range(ends()[1] - ends()[0]):
        assert line.spoil(victim, lambda packet, at=at: flipped(packet, ends()[0] + at)) == valid
    read = line.replies()[0][0]
    assert line.spoil(victim, lambda _: fast(parts_of(read), spoilt=victim)) == valid


@fast_sync
def test_of_a_fast_status_ids_and_head_are_checked_beside_the_crcs(line):
    def sealed(packet, size):
        """With right CRCs of what it is."""
        for end in range(8 + size, len(packet) + 1, size):
            packet = packet[: end - 2] + protocol2.crc(packet[: end - 2]).to_bytes(2, "little") + packet[end:]
        return packet

    for at in range(8):
        size = line.replies()[0][0].awaited[0].length + 4
        valid = line.spoil(0, lambda packet, at=at, size=size: sealed(flipped(packet, at), size))
        assert valid == [False] * 4
    for victim in range(4):
        parts = parts_of(line.replies()[0][0])
        parts[victim] = (99, *parts[victim][1:])
        assert line.spoil(victim, lambda _, parts=parts: fast(parts)) == [one < victim for one in range(4)]


@fast_sync
@pytest.mark.parametrize("victim", range(3))
def test_parts_of_a_fast_status_in_another_order_are_of_no_servo(line, victim):
    parts = parts_of(line.replies()[0][0])
    parts[victim : victim + 2] = reversed(parts[victim : victim + 2])
    assert line.spoil(victim, lambda _: fast(parts)) == [one < victim for one in range(4)]


def parts_of(read):
    return [(one.servo_id, 0, DATA.ljust(one.length, b"\0")) for one in read.awaited]


@sync
@pytest.mark.parametrize("victim", [0, 3])
def test_a_stuffed_reply_of_the_right_length_has_too_few_data(line, victim):
    for at in range(line.replies()[0][0].awaited[0].length - 3):

        def stuffed(packet, at=at):
            data = bytes(at) + b"\xff\xff\xfd\xfd" + bytes(len(packet) - 15 - at)
            return resealed(protocol2, packet[:9] + data + packet[-2:])

        line.spoil(victim, stuffed)


@sync
@pytest.mark.parametrize(
    "other", [b"\x00\xff\xfd\xfd", b"\xff\x00\xfd\xfd", b"\xff\xff\x00\xfd", b"\xff\xff\xfd\x00"]
)
def test_what_is_nearly_stuffed_is_taken_as_it_is(line, other):
    replies = line.altered(
        1, lambda packet: resealed(protocol2, packet[:9] + other + packet[13:-2] + packet[-2:])
    )
    assert line.cycle(replies) == (True, GOOD)


@every
@pytest.mark.parametrize("more", [b"\xff", b"\xff\xff\xfd"])
def test_a_byte_behind_the_replies_is_not_lost(line, more):
    replies = line.replies()
    replies[-1][1].append(more)
    ended, _ = line.cycle(replies)
    assert not ended
    line.cycle()
    line.cycle()
    assert line.side.hardware._buses[0].noise_bytes == len(more)
    line.calm()


@every
def test_replies_come_no_sooner_than_the_wire_allows(line):
    """To the nanosecond: the first reply, of a fast form all of them, behind the instruction."""
    byte_ns = line.side.hardware._buses[0].byte_ns
    for sooner, valid in ((0, True), (1, False)):
        replies = line.replies()
        read, packets = replies[0]
        early_ns = (len(read.packet) + len(packets[0])) * byte_ns - sooner

        def pieces(mine, first=packets, early_ns=early_ns):
            if mine is not first:
                return [(AT_NS, b"".join(mine))]
            return [(early_ns, mine[0]), *([(AT_NS, b"".join(mine[1:]))] if mine[1:] else [])]

        ended, found = line.cycle(replies, pieces)
        assert (ended, found[0]) == (valid, valid)
        line.calm() if valid else None


@every
def test_replies_in_pieces_are_checked_whole_and_pieces_are_bounded(line):
    for most, ends in ((1, None), (2, None), (31, True), (32, True), (33, False)):

        def pieces(packets, most=most):
            data = b"".join(packets)
            cuts = range(0, len(data), most) if most < 3 else range(min(most, len(data)))
            bounds = [*cuts, len(data)]
            return [
                (AT_NS + 10_000 * number, data[start:end])
                for number, (start, end) in enumerate(pairwise(bounds))
            ]

        replies = line.replies()
        longest = max(sum(map(len, packets)) for _, packets in replies)
        ended, valid = line.cycle(replies, pieces)
        assert valid == GOOD
        assert line.heard() == line.given
        if ends is not None and longest > most:
            assert ended == ends
        line.calm()


@plain
def test_a_wrong_byte_at_an_end_of_a_piece_is_seen(line):
    """The ID, as the first or the last byte of what a read() brings; its checksum is right."""
    at = 2 if line.dialect is protocol1 else 4
    for cut in (at, at + 1):  # its first byte, its last

        def pieces(packets, cut=cut):
            data = b"".join(packets)
            return [(AT_NS, data[:cut]), (AT_NS + 50_000, data[cut:])]

        replies = line.altered(0, lambda packet: resealed(line.dialect, flipped(packet, at)))
        ended, valid = line.cycle(replies, pieces)
        assert (ended, valid) == (False, without(0))
        line.calm()


@every
def test_a_line_that_is_ready_without_a_byte_is_waited_for(line, monkeypatch):
    wait, calls = line.side.lines.wait_for_bytes, []

    def ready(deadline_ns):
        calls.append(deadline_ns)
        return [0] if len(calls) == 2 else wait(deadline_ns)

    monkeypatch.setattr(line.side.lines, "wait_for_bytes", ready)
    assert line.cycle() == (True, GOOD)
    assert len(calls) > 2


@every
def test_a_line_that_is_gone_is_left_to_the_parser_at_once(line, monkeypatch):
    looks = []

    def gone(buffer):
        looks.append(len(buffer))
        raise PortError("it is gone")

    monkeypatch.setattr(line.line, "read_into", gone)
    assert line.cycle() == (False, [False] * 4)
    assert str(line.side.hardware._buses[0].failure) == "it is gone"
    assert len(looks) == 2  # the kernel's, and the parser's, which has the reason


@every
def test_reply_is_awaited_from_when_the_host_had_sent_its_request(line):
    line.line.stall_ns = 50_000_000  # longer than any reply is awaited

    def pieces(packets):
        return [(line.line.stall_ns + AT_NS, b"".join(packets))]

    assert line.cycle(pieces=pieces) == (True, GOOD)


@every
def test_reply_that_came_while_the_host_stood_still_is_taken(line, monkeypatch):
    wait = line.side.lines.wait_for_bytes

    def late(deadline_ns):
        if deadline_ns:
            line.side.lines.clock.wait_until(deadline_ns + 30_000_000)
            return []
        return wait(0)

    monkeypatch.setattr(line.side.lines, "wait_for_bytes", late)
    assert line.cycle() == (True, GOOD)
