"""Back to back: what every host on a line of Dynamixels takes for a reply, and what it does not.

A test file names its hosts by subclasses of these contracts, with dxlwire alone or with the whole runtime:

    class TestKernel(SpoiltReplies):
        host = KernelHost

Each test runs for each way to read four servos: single reads, a bulk read, a sync read, a fast sync read. A
`Host` runs a cycle of reads with replies that the test made, and shows whose data it took and what it logged.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import ClassVar

import pytest

from dxlwire.packets import PacketKind
from dxlwire.transaction import Transaction
from dxlwire.wire import protocol1, protocol2
from dxlwire.wire.dialect import Dialect

IDS = (1, 7, 3, 20)
DATA = bytes((0, 2, 0, 0, 0, 0, 0, 2, 0, 0))
"""Of a servo: whatever its layout, its position is the same in each cycle, and in its range."""
AT_NS = 1_500_000
GOOD = [True] * 4
PLAIN = ["single reads", "bulk read", "sync read"]
MODELS = {
    "single reads": "AX-12A",
    "bulk read": "MX-28",
    "sync read": "XM430-W350",
    "fast sync read": "XM430-W350",
}

Replies = list[tuple[Transaction, list[bytes]]]
Pieces = list[tuple[int, bytes]]
Alteration = Callable[[bytes], bytes]


def at_once(packets: list[bytes]) -> Pieces:
    return [(AT_NS, b"".join(packets))]


class Host:
    """A host that reads four servos on one line in a way."""

    dialect: Dialect
    byte_ns = 10_000

    def __init__(self, way: str) -> None:
        raise NotImplementedError

    def reads(self) -> Sequence[Transaction]:
        """Return the reads of the next cycle."""
        raise NotImplementedError

    def exchange(self, given: list[tuple[bytes, Pieces]]) -> list[bool]:
        """Send each read, get its replies, as bytes at times since it; return whose data were taken."""
        raise NotImplementedError

    @property
    def log(self) -> list[tuple[PacketKind, bytes, int]]:
        """Kind, bytes and time of the last byte of each packet of the newest cycle."""
        raise NotImplementedError

    @property
    def errors(self) -> list[int]:
        """The error byte of each servo."""
        raise NotImplementedError

    @property
    def noise_bytes(self) -> int:
        raise NotImplementedError

    def check_reader(self, by_kernel: bool) -> None:
        """Judge whether the kernel read the cycle to its end; only a host that has one."""

    # What tests use

    def replies(self, data: bytes = DATA) -> Replies:
        """Return the replies to each read of a cycle, as packets."""
        found: Replies = []
        for read in self.reads():
            parts = [(one.servo_id, 0, data[: one.length].ljust(one.length, b"\0")) for one in read.awaited]
            found.append(
                (read, [fast(parts)] if read.fast else [self.dialect.status_packet(*one) for one in parts])
            )
        return found

    def cycle(
        self,
        replies: Replies | None = None,
        pieces: Callable[[list[bytes]], Pieces] = at_once,
        *,
        by_kernel: bool | None = None,
    ) -> list[bool]:
        """Run a cycle; return whose data were taken."""
        given = [(read.packet, pieces(packets)) for read, packets in replies or self.replies()]
        self.given = b"".join(data for _, mine in given for _, data in mine)
        valid = self.exchange(given)
        if by_kernel is not None:
            self.check_reader(by_kernel)
        return valid

    def calm(self) -> None:
        """Let every servo answer until the kernel reads again."""
        for _ in range(7):
            self.cycle()
        assert self.cycle(by_kernel=True) == GOOD

    def heard(self) -> bytes:
        """Return all bytes that the log has of what came in the newest cycle."""
        return b"".join(data for kind, data, _ in self.log if kind is not PacketKind.INSTRUCTION)

    @property
    def head(self) -> int:
        """Bytes in front of a reply's data."""
        return self.dialect.OVERHEAD - self.dialect.CHECKSUM

    def resealed(self, packet: bytes) -> bytes:
        """Return a packet with the right checksum of what it is now."""
        if self.dialect is protocol1:
            return packet[:-1] + bytes((protocol1.checksum(packet[2:-1]),))
        return packet[:-2] + protocol2.crc(packet[:-2]).to_bytes(2, "little")

    def altered(self, victim: int, alter: Alteration) -> Replies:
        """Return the replies with that of one servo altered."""
        replies = self.replies()
        number, place = (victim, 0) if len(replies) > 1 else (0, victim)
        packets = replies[number][1]
        place = min(place, len(packets) - 1)  # a fast status has all of them
        packets[place] = alter(packets[place])
        return replies

    def spoil(self, victim: int, alter: Alteration) -> list[bool]:
        """Alter a servo's reply, or the fast status: it is not taken, and every byte is logged. Return whose
        data were taken; then all is as it was.
        """
        valid = self.cycle(self.altered(victim, alter), by_kernel=False)
        assert not valid[victim]
        assert self.heard() == self.given
        self.calm()
        return valid


def fast(parts: Sequence[tuple[int, int, bytes]], spoilt: int = -1) -> bytes:
    """Return a fast status; `spoilt`: a part with a wrong CRC, which those behind it cover as it is."""
    size = sum(len(data) + 4 for _, _, data in parts) + 1
    packet = protocol2.HEADER + b"\xfe" + size.to_bytes(2, "little") + b"\x55"
    for number, (servo_id, error, data) in enumerate(parts):
        packet += bytes((error, servo_id)) + data
        packet += (protocol2.crc(packet) ^ (number == spoilt)).to_bytes(2, "little")
    return packet


def parts_of(read: Transaction) -> list[tuple[int, int, bytes]]:
    return [(one.servo_id, 0, DATA.ljust(one.length, b"\0")) for one in read.awaited]


def without(victim: int) -> list[bool]:
    return [servo != victim for servo in range(4)]


def flipped(packet: bytes, at: int) -> bytes:
    return packet[:at] + bytes((packet[at] ^ 1,)) + packet[at + 1 :]


every = pytest.mark.parametrize("line", [*PLAIN, "fast sync read"], indirect=True)
plain = pytest.mark.parametrize("line", PLAIN, indirect=True)
groups = pytest.mark.parametrize("line", PLAIN[1:], indirect=True)
sync = pytest.mark.parametrize("line", ["sync read"], indirect=True)
fast_sync = pytest.mark.parametrize("line", ["fast sync read"], indirect=True)


class SpoiltReplies:
    """Good replies are taken, whatever their pieces; what is not quite one is not, and is never lost."""

    host: ClassVar[type[Host]]

    @pytest.fixture
    def line(self, request: pytest.FixtureRequest):
        host = self.host(request.param)
        host.calm()
        return host

    @every
    def test_data_may_be_anything_that_is_no_jump(self, line):
        for number in range(20):
            data = bytes((0, 2, number, 0, number, 3, 0, 2, 0, 0))
            assert line.cycle(line.replies(data), by_kernel=True) == GOOD
            assert line.heard() == line.given

    @every
    def test_replies_in_pieces_are_taken_and_logged_whole(self, line):
        for most, by_kernel in ((1, None), (2, None), (31, True), (32, True), (33, False)):

            def pieces(packets, most=most):
                data = b"".join(packets)
                cuts = range(0, len(data), most) if most < 3 else range(min(most, len(data)))
                bounds = enumerate(pairwise([*cuts, len(data)]))
                return [(AT_NS + 10_000 * number, data[start:end]) for number, (start, end) in bounds]

            replies = line.replies()
            longest = max(sum(map(len, packets)) for _, packets in replies)
            bounded = by_kernel if longest > most else None  # the kernel takes so many pieces
            assert line.cycle(replies, pieces, by_kernel=bounded) == GOOD
            assert line.heard() == line.given
            line.calm()

    @plain
    @pytest.mark.parametrize("victim", [0, 1, 3])
    def test_a_reply_with_a_flipped_bit_is_not_taken(self, line, victim):
        for at in range(len(line.replies()[0][1][0])):
            line.spoil(victim, lambda packet, at=at: flipped(packet, at))

    @plain
    @pytest.mark.parametrize("victim", [0, 3])
    def test_each_byte_in_front_of_the_data_is_checked_beside_the_checksum(self, line, victim):
        """With the right checksum: header, ID, length and, in Protocol 2.0, the instruction byte."""
        for at in range(line.head - 1):
            line.spoil(victim, lambda packet, at=at: line.resealed(flipped(packet, at)))

    @plain
    @pytest.mark.parametrize("data", [0, 255])  # so that each bit is 0 once, and 1
    def test_each_bit_of_a_checksum_counts(self, line, data):
        for place, bit in ((place, bit) for place in range(1, 1 + line.dialect.CHECKSUM) for bit in range(8)):

            def alter(packet, place=place, bit=bit):
                at = line.head + 2
                wrong = bytearray(line.resealed(packet[:at] + bytes((data,)) + packet[at + 1 :]))
                wrong[-place] ^= 1 << bit
                return bytes(wrong)

            line.spoil(1, alter)

    @plain
    def test_only_the_right_length_and_a_status_count(self, line):
        status = line.dialect.status_packet
        wrongs = (
            lambda packet: status(7, 0, packet[line.head : -line.dialect.CHECKSUM - 1]),
            lambda packet: status(7, 0, packet[line.head : -line.dialect.CHECKSUM] + b"\0"),
            lambda packet: status(99, 0, packet[line.head : -line.dialect.CHECKSUM]),
            lambda packet: packet[:-3],
            lambda packet: line.dialect.read_range(7, 36, 6),  # of another host
            lambda packet: b"",
        )
        for wrong in wrongs:
            assert line.spoil(1, wrong) == without(1)

    @groups
    def test_replies_in_another_order_or_twice_are_taken_by_id(self, line):
        for order in ((1, 0, 2, 3), (3, 2, 1, 0), (0, 0, 1, 2, 3), (0, 1, 1, 2, 3)):
            replies = line.replies()
            replies[0][1][:] = [replies[0][1][place] for place in order]
            assert line.cycle(replies, by_kernel=False) == GOOD
            assert line.heard() == line.given
            line.calm()

    @every
    def test_a_reply_whose_last_byte_comes_alone_is_taken_with_its_time(self, line):
        replies = line.replies()
        read, packets = replies[0]
        first = len(packets[0]) if len(packets) > 1 else 2
        early_ns = (len(read.packet) + first) * line.byte_ns

        def pieces(mine):
            """The first byte comes sooner than the whole reply could, the whole does not."""
            data = b"".join(mine)
            cuts = [(1, 1), (early_ns, first)] if mine is packets and len(packets) > 1 else [(1, 1)]
            ends = [0, *(end for _, end in cuts), len(data) - 1, len(data)]
            times = [*(at for at, _ in cuts), AT_NS, AT_NS + 7]
            return [(at, data[start:end]) for at, (start, end) in zip(times, pairwise(ends), strict=True)]

        assert line.cycle(replies, pieces, by_kernel=True) == GOOD
        times = {kind: at for kind, _, at in line.log}
        assert times[PacketKind.STATUS] == times[PacketKind.INSTRUCTION] + AT_NS + 7

    @every
    def test_replies_come_no_sooner_than_the_wire_allows(self, line):
        """To the nanosecond: the first reply, of a fast form all of them, behind the instruction."""
        for sooner, valid in ((0, True), (1, False)):
            replies = line.replies()
            read, packets = replies[0]
            early_ns = (len(read.packet) + len(packets[0])) * line.byte_ns - sooner

            def pieces(mine, first=packets, early_ns=early_ns):
                if mine is not first:
                    return at_once(mine)
                return [(early_ns, mine[0]), *([(AT_NS, b"".join(mine[1:]))] if mine[1:] else [])]

            assert line.cycle(replies, pieces, by_kernel=valid)[0] == valid
            line.calm()

    @plain
    def test_an_error_byte_beside_data_is_kept_with_them(self, line):
        error = 0x20 if line.dialect is protocol1 else 0x80

        def alter(packet):
            return line.resealed(packet[: line.head - 1] + bytes((error,)) + packet[line.head :])

        assert line.cycle(line.altered(1, alter), by_kernel=False) == GOOD
        assert line.errors == [0, error, 0, 0]

    @every
    @pytest.mark.parametrize("more", [b"\xff", b"\xff\xff\xfd"], ids=bytes.hex)
    def test_a_byte_behind_the_replies_is_not_lost(self, line, more):
        replies = line.replies()
        replies[-1][1].append(more)
        line.cycle(replies, by_kernel=False)
        line.cycle()
        line.cycle()
        assert line.noise_bytes == len(more)
        line.calm()

    @plain
    def test_a_wrong_byte_at_an_end_of_a_piece_is_seen(self, line):
        """The ID, as the first or the last byte of what a read() brings; its checksum is right."""
        at = 2 if line.dialect is protocol1 else 4
        for cut in (at, at + 1):

            def pieces(packets, cut=cut):
                data = b"".join(packets)
                return [(AT_NS, data[:cut]), (AT_NS + 50_000, data[cut:])]

            replies = line.altered(0, lambda packet: line.resealed(flipped(packet, at)))
            assert line.cycle(replies, pieces, by_kernel=False) == without(0)
            line.calm()

    @sync
    @pytest.mark.parametrize("victim", [0, 3])
    def test_a_stuffed_reply_of_the_right_length_has_too_few_data(self, line, victim):
        for at in range(line.replies()[0][0].awaited[0].length - 3):

            def stuffed(packet, at=at):
                data = bytes(at) + b"\xff\xff\xfd\xfd" + bytes(len(packet) - 15 - at)
                return line.resealed(packet[:9] + data + packet[-2:])

            line.spoil(victim, stuffed)

    @sync
    def test_stuffed_data_have_their_length_without_stuffing(self, line):
        data = DATA[:2] + b"\xff\xff\xfd\x02" + DATA[6:]
        stuffed = protocol2.status_packet(7, 0, data)
        assert len(stuffed) == len(line.replies()[0][1][1]) + 1
        assert line.cycle(line.altered(1, lambda _: stuffed), by_kernel=False) == GOOD

    @sync
    @pytest.mark.parametrize("other", ["00fffdfd", "ff00fdfd", "ffff00fd", "fffffd00"])
    def test_what_is_nearly_stuffed_is_taken_as_it_is(self, line, other):
        near = bytes.fromhex(other)
        replies = line.altered(1, lambda packet: line.resealed(packet[:9] + near + packet[13:]))
        assert line.cycle(replies, by_kernel=True) == GOOD

    @fast_sync
    @pytest.mark.parametrize("victim", range(4))
    def test_each_part_of_a_fast_status_has_a_crc_of_its_own(self, line, victim):
        valid, read = [servo < victim for servo in range(4)], line.replies()[0][0]
        size = read.awaited[0].length + 4
        for at in range(8 + victim * size, 8 + (victim + 1) * size):
            assert line.spoil(victim, lambda packet, at=at: flipped(packet, at)) == valid
        assert line.spoil(victim, lambda _: fast(parts_of(read), spoilt=victim)) == valid

    @fast_sync
    def test_ids_and_head_of_a_fast_status_are_checked_beside_the_crcs(self, line):
        size = line.replies()[0][0].awaited[0].length + 4

        def sealed(packet):
            """With right CRCs of what it is."""
            for end in range(8 + size, len(packet) + 1, size):
                crc = protocol2.crc(packet[: end - 2]).to_bytes(2, "little")
                packet = packet[: end - 2] + crc + packet[end:]
            return packet

        for at in range(8):
            assert line.spoil(0, lambda packet, at=at: sealed(flipped(packet, at))) == [False] * 4
        for victim in range(4):
            parts = parts_of(line.replies()[0][0])
            parts[victim] = (99, *parts[victim][1:])
            assert line.spoil(victim, lambda _, parts=parts: fast(parts)) == [
                one < victim for one in range(4)
            ]

    @fast_sync
    @pytest.mark.parametrize("victim", range(3))
    def test_parts_of_a_fast_status_in_another_order_are_of_no_servo(self, line, victim):
        parts = parts_of(line.replies()[0][0])
        parts[victim : victim + 2] = reversed(parts[victim : victim + 2])
        assert line.spoil(victim, lambda _: fast(parts)) == [one < victim for one in range(4)]
