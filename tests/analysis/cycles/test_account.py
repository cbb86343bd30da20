"""Waits of a read on its buses: which packet of which bus it was that made the cycle long."""

from collections.abc import Sequence

import numpy as np
import pytest
from msgspec import structs

from dxlrun.channels.logged_packets import LoggedPacket
from dxlrun.log.columns import PacketColumns
from dxlrun_analysis.causes.account import Account
from dxlrun_analysis.plan_excerpt import LoggedBus
from dxlrun_analysis.servos.exchanges import Pairing
from dxlwire.packets import PacketKind
from dxlwire.wire import protocol2

PERIOD = 10_000  # us, as all times here
IDS = (1, 2, 3)
SIZE = 4
ASK = protocol2.sync_read(132, SIZE, IDS)
REPLY = 11 + SIZE  # Bytes of its replies
DELAY = 100
STEP = DELAY + REPLY * 10  # From one reply to the next at 1 Mbit/s
BUS = LoggedBus("main", protocol=2.0, baud_rate=1_000_000, return_delay_ns=DELAY * 1000, latency_ns=0)
NAMES = ("scheduled", "woken", "read", "updated", "written", "period", "late")


def asked(at: int, bus: int = 0) -> LoggedPacket:
    return LoggedPacket(bus, PacketKind.INSTRUCTION, 254, at * 1000, at * 1000, ASK)


def replies(at: int, ends: Sequence[int], bus: int = 0) -> list[LoggedPacket]:
    """Return replies that were there so long after the instruction."""
    return [reply(servo, at + end, bus) for servo, end in zip(IDS, ends, strict=False)]


def reply(servo: int, end: int, bus: int = 0) -> LoggedPacket:
    data = protocol2.status_packet(servo, 0, bytes(SIZE))
    return LoggedPacket(bus, PacketKind.STATUS, servo, end * 1000, end * 1000, data)


def read_alone(servo: int, at: int, late: int) -> list[LoggedPacket]:
    data = protocol2.read_range(servo, 132, SIZE)
    request = LoggedPacket(0, PacketKind.INSTRUCTION, servo, at * 1000, at * 1000, data)
    return [request, reply(servo, at + ALONE + late)]


def split(took: int, packets: Sequence[LoggedPacket], *buses: LoggedBus) -> dict[tuple[str, int, int], float]:
    """Split a cycle whose read took so long."""
    times = (0, 0, took, took + 10, took + 20, PERIOD, 0)
    dtype = [*((name, "i8") for name in NAMES), ("long", "?"), ("controllers", "i8", (1,))]
    cycle = np.zeros(1, dtype)[0]
    for name, us in zip(NAMES, times, strict=True):
        cycle[name] = us * 1000
    cycle["long"] = True
    account = Account(cycle, None, PacketColumns.from_packets(packets), Pairing(buses or (BUS,)), ("head",))
    found = {(name.kind, name.bus, name.servo_id): ns / 1000 for name, ns in account.shares.items()}
    del found["own work", -1, -1]
    return found


FIRST = len(ASK) * 10 + STEP
ALONE = 14 * 10 + STEP  # The read of one servo, from its instruction to its reply
PLANNED = [FIRST, FIRST + STEP, FIRST + 2 * STEP]


def late_by(us: float, bus: int = 0) -> dict[tuple[str, int, int], float]:
    """Return what a cycle has of late replies of a bus."""
    return {("late reply", bus, -1): us}


@pytest.mark.parametrize(
    ("ends", "expected"),
    [
        (PLANNED, {}),
        ([end + 5_000 for end in PLANNED], late_by(5_000)),
        ([PLANNED[0], *(end + 5_000 for end in PLANNED[1:])], late_by(5_000)),
        ([*PLANNED[:2], PLANNED[2] + 5_000], late_by(5_000)),
        # lateness that the replies behind make up for has no share; in part, the rest counts
        ([PLANNED[0] + STEP // 2, *PLANNED[1:]], {}),
        ([PLANNED[0] + 500, PLANNED[1] + 400, PLANNED[2] + 1_000], late_by(1_000)),
        ([8_000, 8_000, 8_001], late_by(8_001 - PLANNED[-1])),
    ],
)
def test_the_bus_has_the_time_by_which_the_last_reply_is_late(ends, expected):
    assert split(9_000, [asked(10), *replies(10, ends)]) == expected


def test_of_single_reads_each_counts():
    assert split(9_000, [*read_alone(1, 10, 2_000), *read_alone(2, 5_000, 2_000)]) == late_by(4_000)


def test_what_the_plan_gives_the_adapter_is_not_late():
    ends = [end + 4_000 for end in PLANNED]
    slow = structs.replace(BUS, latency_ns=3_000_000)
    assert split(9_000, [asked(10), *replies(10, ends)], slow) == late_by(1_000)


def test_of_two_buses_the_one_that_was_waited_for_longest_counts():
    late, later = ([end + us for end in PLANNED] for us in (3_000, 5_000))
    packets = [asked(10), asked(10, 1), *replies(10, late), *replies(10, later, 1)]
    assert split(9_000, packets, BUS, structs.replace(BUS, name="other")) == late_by(5_000, bus=1)


@pytest.mark.parametrize("answered", [0, 1, 2])
def test_the_first_servo_without_a_reply_is_waited_for(answered):
    packets = [asked(10), *replies(10, PLANNED[:answered])]
    found = split(9_000, packets)
    ((cause, us),) = found.items()
    # where nothing of a chain came, its instruction may be lost: no servo is accused
    assert cause == ("missing reply", 0, IDS[answered] if answered else -1)
    heard = PLANNED[answered - 1] if answered else len(ASK) * 10
    assert us == 9_000 - 10 - heard


def test_the_requests_of_another_bus_end_no_exchange():
    silent = [asked(10), asked(20, 1), *replies(20, PLANNED, 1)]
    found = split(9_000, silent, BUS, structs.replace(BUS, name="other"))
    assert found == {("missing reply", 0, -1): 9_000 - 10 - len(ASK) * 10}
