"""Another host on the line: its packets and the replies to them leave an event, own faults leave none."""

import math

import pytest
from tests.kit.line_faults import delay_next, other_host, truncate_next
from tests.kit.rigs import make_plan, start_rig

from dxlrun.channels.event_records import EventCode
from dxlrun.dynamixel.servo.servo_supervision import UNREQUESTED_EVENT_NS
from dxlwire.wire import protocol1, protocol2

WAYS = ["plain", "bulk", "sync", "fast"]
IDLE_NS = 15_000_000
"""From the beginning of a cycle to when its exchange is over, and the next one has not begun."""


def build(way):
    """Start four servos that are read in a way; return them, and the dialect of their line."""
    if way in ("plain", "bulk"):
        plan = make_plan((1, 2, 3, 4), model="AX-12A" if way == "plain" else "MX-28")
    else:
        plan = make_plan(
            (1, 2, 3, 4),
            protocol=2.0,
            model="XM430-W350",
            reference=math.pi,
            lower=-2.5,
            upper=2.5,
            fast=way == "fast",
        )
    rig = start_rig(plan)
    rig.cycle()
    return rig, protocol1 if plan.protocol == 1.0 else protocol2


def told(rig):
    return rig.events.of(EventCode.UNREQUESTED)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("heard", [True, False], ids=["adapter of its own", "same adapter"])
def test_another_host_that_asks_between_the_exchanges_leaves_an_event(way, heard):
    rig, dialect = build(way)
    bus = rig.buses[0]
    for number in range(2):
        other_host(bus, dialect.read_range(2, 24, 1), rig.clock.now_ns() + IDLE_NS, received=heard)
        assert told(rig) == []
        rig.cycle()
        assert rig.states.valid.all()
        if heard and not number:
            rig.cycle()
            break
    else:
        rig.cycle()
    ((source, text),) = told(rig)
    assert source == "main"
    assert text.startswith("2 unrequested packets on bus main: another program or")
    assert rig.packets.received() == rig.out_of_bus()
    assert rig.states.valid.all()
    assert rig.torque() == [True] * 4


@pytest.mark.parametrize("way", WAYS)
def test_another_host_that_talks_into_the_exchange_leaves_an_event(way):
    rig, dialect = build(way)
    for _ in range(20):
        other_host(rig.buses[0], dialect.write_range(3, 25, b"\x01"), rig.clock.now_ns() + 600_000)
        rig.cycle()
    assert len(told(rig)) == 1
    assert rig.packets.received() == rig.out_of_bus()


def test_a_host_that_goes_on_leaves_one_event_in_ten_seconds():
    rig, dialect = build("sync")
    since_ns = rig.clock.now_ns()
    while rig.clock.now_ns() < since_ns + 1.5 * UNREQUESTED_EVENT_NS:
        other_host(rig.buses[0], dialect.ping(4), rig.clock.now_ns() + IDLE_NS)
        rig.cycle()
    counts = [int(text.partition(" ")[0]) for _, text in told(rig)]
    assert len(counts) == 2
    assert counts[0] == 2
    assert 900 < counts[1] < 1100  # ten seconds of 50 Hz, an instruction and a status each


def test_one_packet_is_not_yet_another_host():
    rig, dialect = build("plain")
    other_host(
        rig.buses[0], dialect.read_range(9, 24, 1), rig.clock.now_ns() + IDLE_NS
    )  # there is none of this ID
    rig.cycles(3)
    assert told(rig) == []


@pytest.mark.parametrize(("apart", "events"), [(0.9, 1), (1.1, 0)])
def test_two_packets_are_another_host_only_near_each_other(apart, events):
    rig, dialect = build("plain")
    for _ in range(2):
        other_host(rig.buses[0], dialect.read_range(9, 24, 1), rig.clock.now_ns() + IDLE_NS)
        since_ns = rig.clock.now_ns()
        while rig.clock.now_ns() < since_ns + apart * UNREQUESTED_EVENT_NS:
            rig.cycle()
    assert len(told(rig)) == events


def lose(bus, servo_id):
    truncate_next(bus, servo_id, 0)


def delay(bus, servo_id):
    delay_next(bus, servo_id, 14_000_000)


def delay_beyond_the_cycle(bus, servo_id):
    delay_next(bus, servo_id, 31_000_000)


def duplicate(bus, servo_id):
    bus.alter_next(servo_id, "twice", bytes, copies=3)


def noise(bus, servo_id):
    bus.inject_noise(b"\xff\xff\xfd\x00\x05\x07\xff\xff\x02\x04", bus.now_ns + 600_000)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("fault", [lose, delay, delay_beyond_the_cycle, duplicate, noise])
def test_late_doubled_and_broken_replies_are_not_taken_for_those_to_another_host(way, fault):
    rig, _ = build(way)
    for number in range(80):
        if number % 4 == 0:
            fault(rig.buses[0], 1 + number // 4 % 4)
        rig.cycle()
    assert rig.events.of(EventCode.READ_LOST) or fault in (duplicate, noise)
    assert told(rig) == []


@pytest.mark.parametrize("way", WAYS)
def test_a_servo_that_was_away_and_is_asked_again_is_no_other_host(way):
    rig, _ = build(way)
    servo = rig.servo(2)
    for number in range(300):
        if number in (20, 150):
            servo.silence(number == 20)
        if 150 <= number < 190:
            delay(rig.buses[0], 2)
        rig.cycle()
    assert rig.events.of(EventCode.SERVO_LOST)
    assert told(rig) == []
