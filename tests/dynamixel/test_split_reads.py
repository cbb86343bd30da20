"""Split phase: the next states are asked for behind the goals, and wait when the next cycle begins."""

import math

import pytest

from dxlrun.channels.events import EventCode
from dxlrun.dynamixel.wire import protocol1, protocol2

IDS = (11, 12, 13, 14, 15, 16, 17, 18)
X = {
    "name": "arm",
    "protocol": 2.0,
    "model": "XM430-W350",
    "reference": math.pi,
    "lower": -2.5,
    "upper": 2.5,
    "return_delay_ns": 0,
    "fast": True,
    "split": True,
}


@pytest.fixture
def started(make_rig, make_plan):
    rig = make_rig(make_plan(IDS, **X))
    rig.hardware.start()
    rig.cycle()
    return rig


def cycle_ends(rig):
    """Run the end of one cycle and its gap; return when the next one begins."""
    deadline = rig.clock.now_ns() + rig.period_ns
    rig.hardware.write()
    rig.hardware.idle(deadline)
    rig.clock.wait_until(deadline)
    return deadline


def test_the_read_leaves_right_behind_the_goals(started):
    started.hardware.read()
    since, at_ns = len(started.ledger.entries), started.clock.now_ns()
    started.goals.position[:] += 0.1
    started.hardware.write()
    goals, read = [e for e in started.ledger.entries[since:] if e.direction == "in"]
    assert goals.data[7] == 0x83
    assert read.data == protocol2.sync_read(126, 10, IDS, fast=True)
    assert started.clock.now_ns() == at_ns  # nobody waited for the line


def test_a_cycle_begins_with_replies_that_are_there(started):
    started.hardware.read()
    started.goals.position[:] += 0.1
    cycle_ends(started)
    start = started.clock.now_ns()
    started.hardware.read()
    assert started.clock.now_ns() == start
    assert started.states.valid.all()
    # goals 14 + 8 * 9, request 22, status 120 bytes of 10 us each: as long after the write they arrived
    assert set(started.states.age_ns.tolist()) == {started.period_ns - (86 + 22 + 120) * 10_000}


def test_every_byte_is_in_the_log_and_every_cycle_has_new_states(started):
    for _ in range(20):
        started.goals.position[:] += 0.01
        started.cycle()
        assert started.states.valid.all()
        assert (started.states.age_ns < started.period_ns).all()
    assert started.events.of(EventCode.READ_LOST) == []
    assert started.hardware.stop() == ()
    assert started.packets.sent() == started.into_bus()
    assert started.packets.received() == started.out_of_bus()


def test_what_is_not_there_in_time_is_waited_for(started):
    started.hardware.read()
    started.goals.position[:] += 0.1
    started.period_ns = 1_500_000  # goals and states take 2.28 ms
    written = started.clock.now_ns()
    assert cycle_ends(started) == started.clock.now_ns()
    started.hardware.read()
    assert started.clock.now_ns() == written + (86 + 22 + 120) * 10_000
    assert started.states.valid.all()


def test_a_silent_servo_costs_the_others_no_state(started):
    started.buses[0].servo(13).silence()
    for _ in range(4):
        started.cycle()
    assert started.states.valid.tolist() == [True, True, False, True, True, True, True, True]


@pytest.mark.parametrize("compiled", [False, True])
def test_a_servo_that_returns_behind_the_request_has_not_missed_it(make_rig, make_plan, compiled):
    """The states of the next cycle are on their way already when a lost servo is found in order."""
    started = make_rig(make_plan(IDS, **X), compiled=compiled)
    started.hardware.start()
    servo = started.buses[0].servo(13)
    servo.silence()
    while not started.events.of(EventCode.SERVO_LOST):
        started.cycle()
    servo.silence(False)
    while not started.events.of(EventCode.SERVO_BACK):
        started.cycle()
    since = len(started.ledger.entries)
    while not started.states.valid[2]:
        started.goals.position[:] += 0.001
        started.cycle()
    lost = [source for source, _ in started.events.of(EventCode.READ_LOST)]
    assert lost.count("arm_13_joint") == 1
    assert "arm_13_joint" not in {source for source, _ in started.events.of(EventCode.READ_BACK)}
    sent = [entry.data for entry in started.ledger.entries[since:] if entry.direction == "in"]
    first = next(at for at, data in enumerate(sent) if data[7] == 0x8A and 13 in data[14:-2])
    goals = [data for data in sent[:first] if data[7] == 0x83]
    assert goals
    assert not any(13 in data[12:-2:9] for data in goals), "it got a goal before its state was asked for"
    for _ in range(3):
        started.goals.position[:] += 0.01
        started.cycle()
    assert started.states.valid.all()
    goals = [
        entry.data for entry in started.ledger.entries if entry.direction == "in" and entry.data[7] == 0x83
    ]
    assert 13 in goals[-1][12:-2:9]


def test_servos_that_are_read_one_by_one_are_read_in_the_gap(make_rig, make_plan):
    rig = make_rig(make_plan((1, 2, 3), split=True))
    rig.hardware.start()
    rig.cycle()
    rig.hardware.read()
    since = len(rig.ledger.entries)
    cycle_ends(rig)
    asked = [e.data for e in rig.ledger.entries[since:] if e.direction == "in" and e.data[4] == 2]
    assert asked == [protocol1.read(servo_id, 36, 6) for servo_id in (1, 2, 3)]
    start = rig.clock.now_ns()
    rig.hardware.read()
    assert rig.clock.now_ns() == start
    assert rig.states.valid.all()


def test_a_split_bus_and_one_that_is_not_share_a_robot(make_rig, make_plan):
    rig = make_rig(make_plan((1, 2), name="head"), make_plan(IDS, **X | {"first_row": 2}))
    rig.hardware.start()
    for _ in range(5):
        rig.cycle()
        assert rig.states.valid.all()
    for bus in (0, 1):
        assert rig.packets.sent(bus) == rig.into_bus(bus)
        assert rig.packets.received(bus) == rig.out_of_bus(bus)


def test_what_waits_for_a_gap_is_done_behind_the_states(started):
    started.buses[0].servo(14).poke("hardware_error_status", 0x20)
    for _ in range(6):
        started.cycle()
    told = [text for source, text in started.events.of(EventCode.SERVO_ERROR) if source == "arm_14_joint"]
    assert "overload error" in told[1]
    assert started.states.valid.all()


@pytest.mark.parametrize("compiled", [False, True])
def test_a_line_that_is_gone_between_request_and_reply_is_asked_anew(make_rig, make_plan, compiled):
    started = make_rig(make_plan(IDS, **X), compiled=compiled)
    started.hardware.start()
    for _ in range(10):
        started.cycle()
    started.hardware.read()
    started.hardware.write()
    started.buses[0].unplug()
    started.hardware.idle(started.clock.now_ns() + started.period_ns)
    started.hardware.read()
    assert not started.states.valid.any()
    started.buses[0].plug_in()
    for _ in range(150):
        started.cycle()
        if len(started.events.of(EventCode.SERVO_BACK)) == len(IDS):
            break
        back = {source for source, _ in started.events.of(EventCode.SERVO_BACK)}
        valid = {
            servo.joint
            for servo, one in zip(started.plans[0].servos, started.states.valid, strict=True)
            if one
        }
        assert valid <= back  # the plan from before the loss is not read any more
    assert len(started.events.of(EventCode.SERVO_BACK)) == len(IDS)
    for _ in range(2):
        started.cycle()
    assert started.states.valid.all()


@pytest.mark.parametrize("compiled", [False, True])
def test_a_line_that_is_back_leaves_the_requests_on_another_line_alone(make_rig, make_plan, compiled):
    second = make_plan((21, 22), **{**X, "name": "leg"}, first_row=8)
    started = make_rig(make_plan(IDS, **X), second, compiled=compiled)
    started.hardware.start()
    for _ in range(10):
        started.cycle()
    started.hardware.read()
    started.buses[0].unplug()
    started.goals.position[:] += 0.01
    started.hardware.write()
    started.buses[0].plug_in()
    deadline = started.clock.now_ns() + started.period_ns
    started.hardware.idle(deadline)
    started.clock.wait_until(deadline)
    started.hardware.read()
    assert started.states.valid.tolist() == [False] * 8 + [True] * 2
    for _ in range(150):
        started.hardware.write()
        started.hardware.idle(started.clock.now_ns() + started.period_ns)
        started.clock.wait_until(started.clock.now_ns() + started.period_ns)
        started.hardware.read()
        assert started.states.valid[8:].all()
    assert started.states.valid.all()
    assert {source for source, _ in started.events.of(EventCode.READ_LOST)} <= {
        servo.joint for servo in started.plans[0].servos
    }
    assert started.packets.sent(1) == started.into_bus(1)


def test_what_came_before_a_read_is_asked_behind_the_goals_is_none_of_its_replies(started):
    for _ in range(5):
        started.goals.position[:] += 0.01
        started.cycle()
    started.hardware.read()
    stray = started.packets.list[-1].data
    started.ports.ports[0]._arrived += stray
    since = len(started.packets.list)
    started.goals.position[:] += 0.01
    cycle_ends(started)
    started.hardware.read()
    assert [packet.data for packet in started.packets.list[since + 1 : -1]] == [
        stray,
        protocol2.sync_read(126, 10, IDS, fast=True),
    ]
    assert started.states.valid.all()
