"""Replies to a group read that are sent ahead or handed over together: as those one by one."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest
from tests.kit.line_faults import corrupt_next, delay_next, truncate_next
from tests.kit.packets import packet2

from dxlsim.bus.ledger import Ledger, LedgerEntry
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.simulation_plan import AdapterConfig, BusConfig, ServoConfig

MICROFRAME_NS = 125_000
SYNC_READ, FAST_SYNC_READ, BULK_READ = 0x82, 0x8A, 0x92
PRESENT_POSITION = bytes((132, 0, 4, 0))
IDS = (1, 2, 3, 4, 5)


def bus_of(ledger: Ledger, *, absent: str = "silent", baud_rate: int = 4_000_000) -> SimulatedBus:
    servos = tuple(ServoConfig(each, "XM430-W350", 0.5 * each, return_delay_ns=0) for each in IDS)
    config = BusConfig(
        "b", baud_rate, servos, 2.0, adapter=AdapterConfig(absent="slot" if absent == "slot" else "silent")
    )
    return SimulatedBus(config, ledger, 0)


def question(chance: random.Random) -> bytes:
    ids = bytes(chance.sample((*IDS, 9), chance.randint(1, 6)))
    match chance.randint(0, 3):
        case 0:
            return packet2(0xFE, BULK_READ, b"".join(bytes((each,)) + PRESENT_POSITION for each in ids))
        case 1:
            return packet2(0xFE, FAST_SYNC_READ, PRESENT_POSITION + ids)
        case 2:
            goals = b"".join(bytes((each, chance.randrange(256), chance.randrange(16), 0, 0)) for each in ids)
            return packet2(0xFE, 0x83, bytes((116, 0, 4, 0)) + goals)
        case _:
            return packet2(0xFE, SYNC_READ, PRESENT_POSITION + ids)


def disturb(bus: SimulatedBus, chance: random.Random, now_ns: int) -> None:
    servo_id = chance.choice(IDS)
    match chance.randint(0, 12):
        case 0:
            corrupt_next(bus, servo_id)
        case 1:
            truncate_next(bus, servo_id, chance.randint(0, 9))
        case 2:
            delay_next(bus, servo_id, chance.randrange(200_000))
        case 3:
            bus.inject_noise(b"\x55\xaa", now_ns + chance.randrange(300_000))
        case 4:
            bus.at(now_ns + chance.randrange(300_000), bus.servo(servo_id).silence)
            bus.at(now_ns + 400_000, lambda: bus.servo(servo_id).silence(False))
        case _:
            pass


def entries_of(
    seed: int,
    absent: str,
    next_ns: Callable[[SimulatedBus], int | None],
    *,
    midway: bool = False,
    one_by_one: bool = False,
) -> tuple[list[LedgerEntry], int]:
    """Return the ledger of random traffic, and how often bytes were handed over.

    `midway`: some of what disturbs it comes between the replies.
    `one_by_one`: whatever was sent ahead is withdrawn every 5 us.
    """
    chance, ledger, now_ns, hands = random.Random(seed), Ledger(), 0, 0
    bus = bus_of(ledger, absent=absent)
    bus.receive_bytes(
        packet2(0xFE, 0x83, bytes((64, 0, 1, 0)) + b"".join(bytes((each, 1)) for each in IDS)), 0
    )
    for _ in range(60):
        disturb(bus, chance, now_ns)
        if one_by_one:
            for t_ns in range(now_ns, now_ns + 300_000, 5_000):
                bus.at(t_ns, lambda: bus.alter_next(99, "of a servo that is never read", bytes))
        bus.receive_bytes(question(chance), now_ns)
        if midway and chance.randint(0, 1):
            within_ns = now_ns + chance.randrange(200_000)
            bus.drain_bytes(within_ns)
            disturb(bus, chance, within_ns)
        end_ns = now_ns + chance.choice((200_000, 2_000_000))  # the first is within most replies
        while (due_ns := next_ns(bus)) is not None and due_ns <= end_ns:
            hands += bool(bus.drain_bytes(due_ns))
        bus.drain_bytes(end_ns)
        now_ns = end_ns
    return ledger.entries, hands


@pytest.mark.parametrize("absent", ["silent", "slot"])
@pytest.mark.parametrize("seed", range(4))
def test_gathered_replies_are_in_the_ledger_as_single_ones(seed, absent):
    def of_bus(entries: list[LedgerEntry]) -> list[LedgerEntry]:
        """Return entries in the order of time: what is handed over later is entered later."""
        return sorted(entries, key=lambda each: (each.t_ns, each.direction, each.data, each.note))

    single, often = entries_of(seed, absent, SimulatedBus.next_due_ns)
    gathered, seldom = entries_of(seed, absent, lambda bus: bus.next_delivery_ns(MICROFRAME_NS))
    assert of_bus(gathered) == of_bus(single)
    assert seldom < often


@pytest.mark.parametrize("absent", ["silent", "slot"])
@pytest.mark.parametrize("seed", range(4))
def test_replies_sent_ahead_are_those_that_are_decided_one_by_one(seed, absent):
    def entries(one_by_one: bool) -> list[LedgerEntry]:
        return entries_of(seed, absent, SimulatedBus.next_due_ns, midway=True, one_by_one=one_by_one)[0]

    assert entries(one_by_one=False) == entries(one_by_one=True)


def test_no_reply_waits_longer_than_a_microframe_and_the_last_one_not_at_all():
    ledger = Ledger()
    bus = bus_of(ledger)
    bus.receive_bytes(packet2(0xFE, SYNC_READ, PRESENT_POSITION + bytes(IDS)), 0)
    handed = []
    while (due_ns := bus.next_delivery_ns(MICROFRAME_NS)) is not None:
        size = len(bus.drain_bytes(due_ns))
        handed.append((due_ns, size // 15))
    replies = [entry.t_ns for entry in ledger.entries if entry.direction == "out"]
    assert handed == [(replies[3], 4), (replies[4], 1)]  # 37.5 us each: the fourth one ends 112.5 us later
    assert all(each - replies[0] <= MICROFRAME_NS for each in replies[:4])


def test_slow_lines_gather_nothing():
    bus = bus_of(Ledger(), baud_rate=57_600)
    bus.receive_bytes(packet2(0xFE, SYNC_READ, PRESENT_POSITION + bytes(IDS)), 0)
    while (due_ns := bus.next_due_ns()) is not None:
        assert bus.next_delivery_ns(MICROFRAME_NS) == due_ns
        bus.drain_bytes(due_ns)
