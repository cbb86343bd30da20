"""Waits of a read on its buses: which packet of which bus it was that made the cycle long."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from dxlrun.channels.packets import LoggedPacket, PacketKind
from dxlrun.log.columns import PacketColumns
from dxlrun_analysis.causes.account import Account
from dxlrun_analysis.plan import LoggedBus

PERIOD = 10_000
"""us, as all times here."""
IDS = (1, 2, 3)
SIZE = 4
ASK = bytes([255, 255, 253, 0, 254, 10, 0, 0x82, 132, 0, SIZE, 0, *IDS, 0, 0])
"""A sync read of Protocol 2.0."""
REPLY = 11 + SIZE
"""Bytes of its replies."""
DELAY = 100
STEP = DELAY + REPLY * 10
"""From one reply to the next at 1 Mbit/s."""
BUS = LoggedBus("main", protocol=2.0, baud_rate=1_000_000, return_delay_ns=DELAY * 1000, latency_ns=0)


NAMES = ("scheduled", "woken", "read", "updated", "written", "period", "late")


def asked(at: int, bus: int = 0) -> LoggedPacket:
    return LoggedPacket(bus, PacketKind.INSTRUCTION, 254, at * 1000, at * 1000, ASK)


def status(servo: int) -> bytes:
    return bytes([255, 255, 253, 0, servo, 8, 0, 0x55, 0, *bytes(SIZE), 0, 0])


def replies(at: int, ends: Sequence[int], bus: int = 0) -> list[LoggedPacket]:
    """Return replies that were there so long after the instruction."""
    return [
        LoggedPacket(
            bus,
            PacketKind.STATUS,
            servo,
            (at + end) * 1000,
            (at + end) * 1000,
            status(servo),
        )
        for servo, end in zip(IDS, ends, strict=False)
    ]


def split(took: int, packets: Sequence[LoggedPacket], *buses: LoggedBus) -> dict[tuple[str, int, int], float]:
    """Split a cycle whose read took so long."""
    times = (0, 0, took, took + 10, took + 20, PERIOD, 0)
    dtype = [*((name, "i8") for name in NAMES), ("long", "?"), ("controllers", "i8", (1,))]
    cycle = np.zeros(1, dtype)[0]
    for name, us in zip(NAMES, times, strict=True):
        cycle[name] = us * 1000
    cycle["long"] = True
    account = Account(cycle, None, PacketColumns.of(packets), buses or (BUS,), ("head",))
    found = {(name.kind, name.bus, name.servo_id): ns / 1000 for name, ns in account.shares.items()}
    del found["own work", -1, -1]
    return found | {("latest", *servo): 1 for servo in account.latest}


FIRST = len(ASK) * 10 + STEP
PLANNED = [FIRST, FIRST + STEP, FIRST + 2 * STEP]


def test_an_exchange_as_planned_has_no_share() -> None:
    assert split(1_000, [asked(10), *replies(10, PLANNED)]) == {}


@pytest.mark.parametrize("servo", [0, 1, 2])
def test_the_servo_from_which_on_replies_are_late_has_the_time(servo: int) -> None:
    ends = [end + (5_000 if index >= servo else 0) for index, end in enumerate(PLANNED)]
    # what wakes host and adapter is in the first reply, too: it is no servo's
    latest = ("latest", 0, IDS[servo] if servo else -1)
    found = split(9_000, [asked(10), *replies(10, ends)])
    assert found == {("late reply", 0, -1): 5_000, latest: 1}


def test_lateness_that_the_replies_behind_make_up_for_has_no_share() -> None:
    ends = [PLANNED[0] + STEP // 2, *PLANNED[1:]]
    assert split(9_000, [asked(10), *replies(10, ends)]) == {}


def test_of_lateness_that_is_made_up_for_in_part_the_rest_counts() -> None:
    ends = [end + us for end, us in zip(PLANNED, (500, 400, 1_000), strict=True)]
    assert split(9_000, [asked(10), *replies(10, ends)]) == {
        ("late reply", 0, -1): 1_000,
        ("latest", 0, -1): 1,
    }


def test_of_single_reads_only_those_behind_the_first_are_late_by_their_servos() -> None:
    packets = []
    for servo, at in ((1, 10), (2, 5_000)):
        data = bytes([255, 255, 253, 0, servo, 7, 0, 2, 132, 0, SIZE, 0, 0, 0])
        sent, end = at * 1000, at + len(data) * 10 + STEP + 2_000
        packets.append(LoggedPacket(0, PacketKind.INSTRUCTION, servo, sent, sent, data))
        packets.append(replace(replies(0, [end])[0], servo_id=servo, data=status(servo)))
    assert split(9_000, packets) == {("late reply", 0, -1): 4_000, ("latest", 0, -1): 1}


def test_of_two_replies_that_are_late_alike_none_is_the_latest() -> None:
    packets, at = [], 10
    for servo, late in ((1, 0), (2, 3_000), (3, 2_000)):
        data = bytes([255, 255, 253, 0, servo, 7, 0, 2, 132, 0, SIZE, 0, 0, 0])
        end = at + len(data) * 10 + STEP + late
        packets.append(LoggedPacket(0, PacketKind.INSTRUCTION, servo, at * 1000, at * 1000, data))
        packets.append(replace(replies(0, [end])[0], servo_id=servo, data=status(servo)))
        at = end
    assert split(9_000, packets)["latest", 0, -1] == 1


def test_replies_that_came_at_once_are_no_servo_s() -> None:
    assert split(9_000, [asked(10), *replies(10, [8_000, 8_000, 8_001])]) == {
        ("late reply", 0, -1): 8_001 - PLANNED[-1],
        ("latest", 0, -1): 1,
    }


def test_what_the_plan_gives_the_adapter_is_not_late() -> None:
    slow = LoggedBus(
        "main", protocol=2.0, baud_rate=1_000_000, return_delay_ns=DELAY * 1000, latency_ns=3_000_000
    )
    ends = [end + 4_000 for end in PLANNED]
    assert split(9_000, [asked(10), *replies(10, ends)], slow) == {
        ("late reply", 0, -1): 1_000,
        ("latest", 0, -1): 1,
    }


def test_of_two_buses_the_one_that_was_waited_for_longest_counts() -> None:
    other = LoggedBus("other", protocol=2.0, baud_rate=1_000_000, return_delay_ns=DELAY * 1000)
    late, later = ([end + us for end in PLANNED] for us in (3_000, 5_000))
    packets = [asked(10), asked(10, 1), *replies(10, late), *replies(10, later, 1)]
    assert split(9_000, packets, BUS, other) == {
        ("late reply", 1, -1): 5_000,
        ("latest", 1, -1): 1,
    }


@pytest.mark.parametrize("answered", [0, 1, 2])
def test_the_first_servo_without_a_reply_is_waited_for(answered: int) -> None:
    packets = [asked(10), *replies(10, PLANNED[:answered])]
    found = split(9_000, packets)
    ((cause, us),) = found.items()
    # where nothing of a chain came, its instruction may be lost: no servo is accused
    assert cause == ("missing reply", 0, IDS[answered] if answered else -1)
    heard = PLANNED[answered - 1] if answered else len(ASK) * 10
    assert us == 9_000 - 10 - heard
