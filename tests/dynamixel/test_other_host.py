"""Another host on the line: its packets and the replies to them leave an event, own faults leave none."""

import pytest
from tests.kit.line_faults import delay_next, other_host, truncate_next
from tests.kit.rigs import make_plan, make_x, start_rig

from dxlrun.channels.event_records import EventCode
from dxlrun.dynamixel.servo.servo_supervision import UNREQUESTED_EVENT_NS
from dxlwire.wire import protocol1, protocol2

IDLE_NS = 15_000_000
"""From the beginning of a cycle to when its exchange is over, and the next one has not begun."""
IDS = (1, 2, 3, 4)
PLANS = {
    "plain": make_plan(IDS),
    "bulk": make_plan(IDS, model="MX-28"),
    "sync": make_x(IDS, name="main", return_delay_ns=500_000),
    "fast": make_x(IDS, name="main", return_delay_ns=500_000, fast=True),
}
every = pytest.mark.parametrize("shared", PLANS, indirect=True)
plain = pytest.mark.parametrize("shared", ["plain"], indirect=True)


class Shared:
    """Four servos that are read in a way, and another host on their line."""

    def __init__(self, way):
        self.rig = start_rig(PLANS[way])
        self.rig.cycle()
        self.dialect = protocol1 if PLANS[way].protocol == 1.0 else protocol2
        self.bus = self.rig.buses[0]

    def say(self, packet, after_ns=IDLE_NS, **options):
        """Let the other host send a packet in the next cycle."""
        other_host(self.bus, packet, self.rig.clock.now_ns() + after_ns, **options)

    @property
    def told(self):
        return self.rig.events.of(EventCode.UNREQUESTED)


@pytest.fixture
def shared(request):
    return Shared(request.param)


@every
@pytest.mark.parametrize("heard", [True, False], ids=["adapter of its own", "same adapter"])
def test_another_host_that_asks_between_the_exchanges_leaves_an_event(shared, heard):
    rig = shared.rig
    for _ in range(1 if heard else 2):  # heard are the request and its reply
        shared.say(shared.dialect.read_range(2, 24, 1), received=heard)
        assert shared.told == []
        rig.cycle()
        assert rig.states.valid.all()
    rig.cycle()
    ((source, text),) = shared.told
    assert source == "main"
    assert text.startswith("2 unrequested packets on bus main: another program or")
    assert rig.packets.received() == rig.out_of_bus()
    assert rig.states.valid.all()
    assert rig.torque() == [True] * 4


@every
def test_another_host_that_talks_into_the_exchange_leaves_an_event(shared):
    for _ in range(20):
        shared.say(shared.dialect.write_range(3, 25, b"\x01"), 600_000)
        shared.rig.cycle()
    assert len(shared.told) == 1
    assert shared.rig.packets.received() == shared.rig.out_of_bus()


@pytest.mark.parametrize("shared", ["sync"], indirect=True)
def test_a_host_that_goes_on_leaves_one_event_in_ten_seconds(shared):
    shared.rig.period_ns = 100_000_000
    until_ns = shared.rig.clock.now_ns() + 2.5 * UNREQUESTED_EVENT_NS
    while shared.rig.clock.now_ns() < until_ns:
        shared.say(shared.dialect.ping(4))
        shared.rig.cycle()
    counts = [int(text.partition(" ")[0]) for _, text in shared.told]
    assert len(counts) == 3
    assert counts[0] == 2
    assert 180 < counts[1] < 220  # ten seconds of 10 Hz, an instruction and a status each
    assert abs(counts[2] - counts[1]) <= 4, "each counts its own ten seconds"


@plain
@pytest.mark.parametrize(("apart", "events"), [(None, 0), (0.9, 1), (1.1, 0)])
def test_two_packets_are_another_host_only_near_each_other_and_one_is_not(shared, apart, events):
    shared.rig.period_ns = 100_000_000
    for _ in range(2 if apart else 1):
        shared.say(shared.dialect.read_range(9, 24, 1))  # there is none of this ID
        until_ns = shared.rig.clock.now_ns() + (apart or 0.01) * UNREQUESTED_EVENT_NS
        while shared.rig.clock.now_ns() < until_ns:
            shared.rig.cycle()
    assert len(shared.told) == events


NOISE = b"\xff\xff\xfd\x00\x05\x07\xff\xff\x02\x04"
FAULTS = {
    "lose": lambda bus, servo_id: truncate_next(bus, servo_id, 0),
    "delay": lambda bus, servo_id: delay_next(bus, servo_id, 14_000_000),
    "delay beyond the cycle": lambda bus, servo_id: delay_next(bus, servo_id, 31_000_000),
    "double": lambda bus, servo_id: bus.alter_next(servo_id, "twice", bytes, copies=3),
    "noise": lambda bus, _: bus.inject_noise(NOISE, bus.now_ns + 600_000),
}


@every
@pytest.mark.parametrize("fault", FAULTS)
def test_late_doubled_and_broken_replies_are_not_taken_for_those_to_another_host(shared, fault):
    for number in range(80):
        if number % 4 == 0:
            FAULTS[fault](shared.bus, 1 + number // 4 % 4)
        shared.rig.cycle()
    assert shared.rig.events.of(EventCode.READ_LOST) or fault in ("double", "noise")
    assert shared.told == []


@every
def test_a_servo_that_was_away_and_is_asked_again_is_no_other_host(shared):
    servo = shared.rig.servo(2)
    for number in range(300):
        if number in (20, 150):
            servo.silence(number == 20)
        if 150 <= number < 190:
            FAULTS["delay"](shared.bus, 2)
        shared.rig.cycle()
    assert shared.rig.events.of(EventCode.SERVO_LOST)
    assert shared.told == []
