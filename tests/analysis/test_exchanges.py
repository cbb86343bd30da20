"""The table of exchanges: which reply answers which request, and whose loss a missing one is."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from dxlrun.channels.logged_packets import LoggedPacket
from dxlrun.log.columns import PacketColumns
from dxlrun_analysis.plan_excerpt import LoggedBus
from dxlrun_analysis.servos.broken_replies import BrokenReplies
from dxlrun_analysis.servos.exchanges import Exchanges, Loss, Pairing
from dxlrun_analysis.servos.losses import ServoLosses
from dxlrun_analysis.servos.other_host import OtherHosts
from dxlwire.packets import PacketKind

ASK, STATUS, NOISE, LATE = PacketKind.INSTRUCTION, PacketKind.STATUS, PacketKind.NOISE, PacketKind.LATE
BUS = LoggedBus("main", protocol=2.0, baud_rate=1_000_000)
SYNC_READ = bytes.fromhex("fffffd00fe0a0082840004000307040000")  # servos 3, 7 and 4
FAST_READ = bytes.fromhex("fffffd00fe0a008a840004000307040000")
PING_7, PING_9 = (bytes((0xFF, 0xFF, 0xFD, 0, one, 3, 0, 1, 0, 0)) for one in (7, 9))
PING_ALL = bytes.fromhex("fffffd00fe0300013142")
CUT = b"\xff\xff\xfd\x00\xfe\x1a\x00\x55" + bytes((0, 3, 1, 2, 3, 4, 5, 6))
"""A fast status packet without the blocks of 7 and 4."""
BLOCK = bytes((0, 7, *range(6)))
MS = 1_000_000
Wires = Sequence[tuple[PacketKind, int, bytes, int]]


def status(servo_id: int) -> bytes:
    return bytes([0xFF, 0xFF, 0xFD, 0, servo_id, 8, 0, 0x55, 0, 1, 2, 3, 4, 0, 0])


def columns(wires: Wires) -> PacketColumns:
    """Packets of one bus: kind, ID, bytes, ms."""
    return PacketColumns.from_packets(
        LoggedPacket(0, kind, one, at * MS, at * MS, data) for kind, one, data, at in wires
    )


def paired(wires: Wires) -> Exchanges:
    return Pairing((BUS,)).alone(columns(wires))


def losses(found: Exchanges) -> dict[int, Loss]:
    """Of each servo in the first exchange."""
    mine = found.due.exchange == found.due.exchange[0]
    return {
        servo: Loss(loss) for servo, loss in zip(found.due.servo[mine], found.due.loss[mine], strict=True)
    }


def test_of_a_chain_the_first_silent_servo_has_the_loss() -> None:
    found = paired([(ASK, 254, SYNC_READ, 0), (STATUS, 3, status(3), 1)])
    assert losses(found) == {3: Loss.NONE, 7: Loss.OWN, 4: Loss.BEHIND}
    assert found.due.place.tolist() == [0, 1, 2]
    assert found.due.reply.tolist() == [0, -1, -1]
    assert found.last_ns.tolist() == [0, 1 * MS]


def test_of_a_chain_of_which_nothing_came_it_is_the_line() -> None:
    assert set(losses(paired([(ASK, 254, SYNC_READ, 0)])).values()) == {Loss.LINE}
    assert losses(paired([(ASK, 7, PING_7, 0)])) == {7: Loss.OWN}


def test_the_first_reply_of_a_servo_answers_and_one_that_was_not_asked_does_not() -> None:
    found = paired(
        [(ASK, 7, PING_7, 0), (STATUS, 9, status(9), 1), (STATUS, 7, status(7), 2), (STATUS, 7, status(7), 3)]
    )
    assert found.due.reply.tolist() == [1]
    assert found.replies.answers.tolist() == [False, True, False]
    assert found.replies.place.tolist() == [-1, 0, 0]


@pytest.mark.parametrize(("kind", "loss"), [(LATE, Loss.LATE), (STATUS, Loss.OWN)])
def test_a_reply_that_came_late_is_neither_missing_nor_broken(kind: PacketKind, loss: Loss) -> None:
    wires = [(ASK, 7, PING_7, 0), (NOISE, 254, bytes(3), 1), (ASK, 254, PING_ALL, 2), (kind, 7, status(7), 3)]
    found = paired(wires)
    assert losses(found) == {7: loss}
    assert bool(found.due.broken[0]) == (loss is Loss.OWN)
    assert found.late.exchange.tolist() == [1] * (loss is Loss.LATE)


@pytest.mark.parametrize(("after_ms", "loss"), [(50, Loss.LATE), (150, Loss.OWN)])
def test_the_block_of_a_fast_status_that_comes_by_itself_is_late_and_breaks_no_other(
    after_ms: int, loss: Loss
) -> None:
    wires = [
        (ASK, 254, FAST_READ, 0),
        (STATUS, 254, CUT, 1),
        (ASK, 9, PING_9, 2),
        (NOISE, 254, BLOCK, after_ms),
    ]
    found = paired(wires)
    assert losses(found) == {3: Loss.NONE, 7: loss, 4: Loss.BEHIND}
    assert found.due.broken.tolist() == [False, False, False, loss is Loss.OWN]  # of the ping


def test_packets_that_are_looked_at_alone_wait_for_no_others() -> None:
    pairing, wires = Pairing((BUS,)), [(ASK, 254, SYNC_READ, 0)]
    pairing.alone(columns([(ASK, 254, SYNC_READ, 1000)]))
    assert pairing.alone(columns(wires)).sent_ns.tolist() == paired(wires).sent_ns.tolist()


@pytest.mark.parametrize(("read", "shared"), [(SYNC_READ, False), (FAST_READ, True)])
def test_only_of_a_shared_packet_the_end_may_be_cut(read: bytes, shared: bool) -> None:
    both = bytes((0, 7, 1, 2, 3, 4, 5, 6))
    came = [(STATUS, 254, CUT + both)] if shared else [(STATUS, 3, status(3)), (STATUS, 7, status(7))]
    broken = BrokenReplies(1)
    for _ in range(5):
        broken.add_exchanges(
            paired([(ASK, 254, read, 0), *((*one, 1) for one in came), (NOISE, 254, bytes(5), 2)])
        )
    (finding,) = broken.findings(0, BUS, dict.fromkeys((3, 7, 4), ServoLosses(5, 5, 5)))
    assert "servo 4" in finding.sentence
    assert ("of the shared status packet" in finding.sentence) == shared


WRITE_7 = bytes((0xFF, 0xFF, 0xFD, 0, 7, 6, 0, 3, 64, 0, 1, 0, 0))
SYNC_WRITE = bytes.fromhex("fffffd00fe0b00834000010007010401 0000")


@pytest.mark.parametrize(
    ("wires", "unasked"),
    [
        ([(ASK, 7, PING_7, 0), (STATUS, 7, status(7), 1), (STATUS, 4, status(4), 2)], [4]),
        ([(ASK, 254, SYNC_WRITE, 0), (STATUS, 4, status(4), 2)], [4]),
        ([(ASK, 7, PING_7, 0), (STATUS, 7, status(7), 1), (STATUS, 7, status(7), 2)], []),
        ([(ASK, 7, WRITE_7, 0), (STATUS, 7, status(7), 1)], []),
        ([(ASK, 254, PING_ALL, 0), (STATUS, 7, status(7), 1), (STATUS, 4, status(4), 2)], []),
        ([(ASK, 7, PING_7, 0), (ASK, 254, SYNC_WRITE, 9), (STATUS, 7, status(7), 10)], []),
        ([(ASK, 7, PING_7, 0), (ASK, 254, SYNC_WRITE, 9), (LATE, 4, status(4), 10)], []),
        ([(STATUS, 7, status(7), 0), (ASK, 7, PING_7, 1)], []),
    ],
    ids=["behind", "nothing asked", "twice", "acknowledged", "all asked", "owed", "late", "before all"],
)
def test_a_reply_that_nothing_asked_for(wires: Wires, unasked: list[int]) -> None:
    assert paired(wires).unasked.tolist() == unasked


@pytest.mark.parametrize(
    ("count", "ids", "told"),
    [
        (9, (4,), ""),
        (10, (4,), "10 unrequested replies (of ID 4)."),
        (12, (4, 9), "12 unrequested replies (of IDs 4, 9)."),
    ],
)
def test_a_host_that_uses_the_same_adapter_is_told_by_the_replies_to_it(
    count: int, ids: tuple[int, ...], told: str
) -> None:
    wires = []
    for number in range(count):
        servo_id = ids[number % len(ids)]
        wires += [(ASK, 7, PING_7, 10 * number), (STATUS, 7, status(7), 10 * number + 1)]
        wires += [(STATUS, servo_id, status(servo_id), 10 * number + 2)]
    others = OtherHosts(1)
    others.add_exchanges(paired(wires))
    found = others.findings(0, BUS)
    assert others.explains(0) is bool(told)
    assert [(one.code, one.subject) for one in found] == [("another_host", "main")] * bool(told)
    assert "".join(one.sentence for one in found) == (
        f"Another host uses bus main, or its adapter: {told}" if told else ""
    )
