"""Replies that are sent ahead, and goals that compiled code executes: as those one by one, and by Python."""

import random
from collections.abc import Callable

import pytest
from tests.kit.line_faults import corrupt_next, delay_next, truncate_next
from tests.kit.packets import packet2
from tests.kit.simulated_line import Line

from dxlsim.bus.ledger import Ledger, LedgerEntry
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.simulation_plan import AdapterConfig, BusConfig, ServoConfig
from dxlsim.wire.compiled_line import Task

MICROFRAME_NS = 125_000
SYNC_WRITE, SYNC_READ, FAST_SYNC_READ, BULK_READ = 0x83, 0x82, 0x8A, 0x92
PRESENT_POSITION = bytes((132, 0, 4, 0))
IDS = (1, 2, 3, 4, 5)
READ_ALL = packet2(0xFE, SYNC_READ, PRESENT_POSITION + bytes(IDS))


def bus_of(*, absent: str = "silent", baud_rate: int = 4_000_000) -> SimulatedBus:
    servos = tuple(ServoConfig(each, "XM430-W350", 0.5 * each, return_delay_ns=0) for each in IDS)
    adapter = AdapterConfig(absent="slot" if absent == "slot" else "silent")
    return SimulatedBus(BusConfig("b", baud_rate, servos, 2.0, adapter=adapter), Ledger(), 0)


def question(chance: random.Random) -> bytes:
    ids = bytes(chance.sample((*IDS, 9), chance.randint(1, 6)))
    goals = b"".join(bytes((each, chance.randrange(256), chance.randrange(16), 0, 0)) for each in ids)
    return chance.choice(
        (
            packet2(0xFE, BULK_READ, b"".join(bytes((each,)) + PRESENT_POSITION for each in ids)),
            packet2(0xFE, FAST_SYNC_READ, PRESENT_POSITION + ids),
            packet2(0xFE, SYNC_READ, PRESENT_POSITION + ids),
            packet2(0xFE, SYNC_WRITE, bytes((116, 0, 4, 0)) + goals),
        )
    )


def disturb(bus: SimulatedBus, chance: random.Random, now_ns: int) -> None:
    """Let one of five faults happen in 5 of 13 times."""
    servo_id, later_ns = chance.choice(IDS), now_ns + chance.randrange(300_000)

    def silence() -> None:
        bus.at(later_ns, bus.servo(servo_id).silence)
        bus.at(now_ns + 400_000, lambda: bus.servo(servo_id).silence(False))

    faults: list[Callable[[], object]] = [
        lambda: corrupt_next(bus, servo_id),
        lambda: truncate_next(bus, servo_id, chance.randint(0, 9)),
        lambda: delay_next(bus, servo_id, chance.randrange(200_000)),
        lambda: bus.inject_noise(b"\x55\xaa", later_ns),
        silence,
    ]
    number = chance.randint(0, 12)
    if number < len(faults):
        faults[number]()


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
    chance, now_ns, hands = random.Random(seed), 0, 0
    bus = bus_of(absent=absent)
    torque = b"".join(bytes((each, 1)) for each in IDS)
    bus.receive_bytes(packet2(0xFE, SYNC_WRITE, bytes((64, 0, 1, 0)) + torque), 0)
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
    return bus.ledger.entries, hands


@pytest.mark.parametrize("absent", ["silent", "slot"])
@pytest.mark.parametrize("seed", range(4))
def test_gathered_replies_are_in_the_ledger_as_single_ones(seed, absent):
    def by_time(entries: list[LedgerEntry]) -> list[LedgerEntry]:
        """What is handed over later is entered later."""
        return sorted(entries, key=lambda each: (each.t_ns, each.direction, each.data, each.note))

    single, often = entries_of(seed, absent, SimulatedBus.next_due_ns)
    gathered, seldom = entries_of(seed, absent, lambda bus: bus.next_delivery_ns(MICROFRAME_NS))
    assert by_time(gathered) == by_time(single)
    assert seldom < often


@pytest.mark.parametrize("absent", ["silent", "slot"])
@pytest.mark.parametrize("seed", range(4))
def test_replies_sent_ahead_are_those_that_are_decided_one_by_one(seed, absent):
    ahead, _ = entries_of(seed, absent, SimulatedBus.next_due_ns, midway=True)
    assert ahead == entries_of(seed, absent, SimulatedBus.next_due_ns, midway=True, one_by_one=True)[0]


def test_no_reply_waits_longer_than_a_microframe_and_the_last_one_not_at_all():
    bus, handed = bus_of(), []
    bus.receive_bytes(READ_ALL, 0)
    while (due_ns := bus.next_delivery_ns(MICROFRAME_NS)) is not None:
        handed.append((due_ns, len(bus.drain_bytes(due_ns)) // 15))
    replies = [entry.t_ns for entry in bus.ledger.entries if entry.direction == "out"]
    assert handed == [(replies[3], 4), (replies[4], 1)]  # 37.5 us each: the fourth one ends 112.5 us later
    assert all(each - replies[0] <= MICROFRAME_NS for each in replies[:4])


def test_slow_lines_gather_nothing():
    bus, found = bus_of(baud_rate=57_600), 0
    bus.receive_bytes(READ_ALL, 0)
    while (due_ns := bus.next_due_ns()) is not None:
        assert bus.next_delivery_ns(MICROFRAME_NS) == due_ns
        found += len(bus.drain_bytes(due_ns))
    assert found == 5 * 15


Execute = Callable[[int, int], int | None]
MS = 1_000_000
ITEMS = ("goal_position", "moving_speed", "profile_velocity", "profile_acceleration", "goal_acceleration")
OTHERS = (
    *("cw_angle_limit", "ccw_angle_limit", "min_position_limit", "max_position_limit", "torque_enable"),
    *("torque_enable", "torque_enable", "operating_mode", "drive_mode", "homing_offset", "torque_limit"),
    *("velocity_limit", "acceleration_limit", "goal_pwm", "bus_watchdog", "led", "secondary_id"),
)


def story(model: str, protocol: float, seed: int, *, compiled: bool) -> tuple[list[object], int]:
    """Return everything that passed on the line or was noted, with angles and registers, and the number of
    instructions that Python executed."""
    chance, shown, executed = random.Random(seed), list[object](), 0
    line = Line(model, 1, 2, protocol=protocol)
    for servo in line.bus.servos:
        servo.shaft.response_delay_ns = chance.choice((0, 0, 5 * MS))
        if not compiled:
            servo.line.goal_count = 0
    registers = line.bus.servo(1).registers
    items = registers.table.items
    for task in (Task.EXECUTE, Task.WRITTEN):
        executes = line.bus._tasks[task]

        def count(first: int, second: int, executes: Execute = executes) -> int | None:
            nonlocal executed
            executed += 1
            return executes(first, second)

        line.bus._tasks[task] = count
    aims = [items[name] for name in ITEMS if name in items and items[name].access == "RW"]
    for number in range(150):
        if number % 10 < 2:
            name = (
                "torque_enable" if number < 2 else chance.choice([each for each in OTHERS if each in items])
            )
            item, wire = items[name], chance.choice((0, 1, 3, 4, 16, chance.randrange(1 << 16)))
            value = 1 if number < 2 or (name == "torque_enable" and chance.random() < 0.8) else wire
            data = line.word(item.address) + (value & (1 << 8 * item.size) - 1).to_bytes(item.size, "little")
            line.instruct(1 + number % 2, 3, data)
        else:
            item = chance.choice(aims)
            span = chance.choice((item.maximum, 2 * item.maximum, (1 << 8 * item.size) - 1))
            wires = [chance.randint(0, min(span, (1 << 8 * item.size) - 1)) for _ in range(2)]
            data = b"".join(
                bytes((i, *wire.to_bytes(item.size, "little"))) for i, wire in enumerate(wires, 1)
            )
            line.instruct(0xFE, 0x83, line.word(item.address) + line.word(item.size) + data)
        line.receive(chance.choice((1, 2, 7, 40)) * MS)
        shown += [servo.shaft_angle for servo in line.bus.servos]
        shown += [bytes(servo.registers._memory) for servo in line.bus.servos]
    return [*shown, *line.ledger.entries], executed


@pytest.mark.parametrize(
    ("model", "protocol"),
    [("AX-12A", 1.0), ("MX-64", 1.0), ("XL-320", 2.0), ("XM430-W350", 2.0), ("PH42-020-S300-R", 2.0)],
)
def test_a_goal_acts_as_if_python_had_executed_it(model: str, protocol: float) -> None:
    saved = 0
    for seed in range(3):
        (there, few), (here, all_of_them) = (
            story(model, protocol, seed, compiled=compiled) for compiled in (True, False)
        )
        assert there == here
        saved += all_of_them - few
    assert saved > 100
