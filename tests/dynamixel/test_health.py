"""Servos that are lost, reboot and return: what is asked and when; `cases/returns.txt` has the outcomes."""

from functools import partial

import pytest
from tests.kit.line_faults import truncate_next
from tests.kit.rigs import goals_in, make_plan, make_x, start_rig

from dxlrun.channels.cycle import Torque
from dxlrun.channels.event_records import EventCode
from dxlrun.dynamixel.servo.reboots import RebootCount, TickReading
from dxlwire.modes import Mode
from dxlwire.transaction import Reply, TransactionOutcome
from dxlwire.wire import protocol1, protocol2


@pytest.fixture
def rig():
    return start_rig(make_x((11, 12, 13, 14)))


def test_a_lost_servo_leaves_the_exchange_and_is_asked_once_a_second(rig):
    rig.servo(13).silence()
    rig.cycles(10)
    count = len(rig.into_bus())
    rig.cycles(500)  # ten seconds
    sent = rig.into_bus()[count:]
    to_it = [packet for packet in sent if packet[4] == 13]
    assert set(to_it) == {protocol2.ping(13)}
    assert 9 <= len(to_it) <= 11
    reads = [packet for packet in sent if packet[7] in (0x82, 0x8A)]
    assert len(reads) == 500
    assert all(13 not in packet[12:-2] for packet in reads)
    assert rig.events.sources(EventCode.SERVO_LOST) == ["arm_13_joint"]


def test_a_bus_that_stands_still_for_a_moment_loses_no_servo_at_any_rate(rig):
    """Three cycles at 500 Hz are less than a USB adapter, or a machine, stands still for now and then."""
    begun = rig.clock.now_ns()
    for servo in rig.buses[0].servos:
        servo.silence()
        rig.buses[0].at(begun + 40_000_000, partial(servo.silence, False))
        rig.buses[0].at(begun + 200_000_000, servo.silence)
    missed = 0
    while not (lost := rig.events.of(EventCode.SERVO_LOST)):
        rig.hardware.read_states()
        rig.hardware.write_goals()
        missed += not rig.states.valid.any()
        rig.clock.wait_until(rig.clock.now_ns() + 1_000_000)
    assert 250_000_000 <= rig.clock.now_ns() - begun < 280_000_000
    assert missed > 2 * 3
    assert len(lost) >= 1
    assert len(rig.events.of(EventCode.READ_BACK)) == 4


def test_a_servo_that_is_lost_at_a_high_rate_is_reported_with_all_that_it_missed(rig):
    rig.period_ns = 4_000_000
    rig.servo(13).silence()
    misses = 0
    while not (lost := rig.events.texts(EventCode.SERVO_LOST)):
        rig.cycle(idle=False)
        misses += 1
    assert misses > 5
    assert f"missed {misses} replies in a row" in lost[0]


@pytest.mark.parametrize("rebooted", [False, True])
def test_a_servo_whose_clock_was_not_read_has_not_started_anew_before_it_was(rig, rebooted):
    """Torque enable 0 behind a garbled clock may be the answer of a second servo with its ID."""
    asked = []

    def spoil():
        asked.append(rig.clock.now_ns())
        if len(asked) <= 3:
            truncate_next(rig.buses[0], 13, 5)

    with rig.away(13, 5) as servo:
        if rebooted:
            servo.power_cycle()
        servo.poke("torque_enable", 0)
        rig.when(lambda data: data == protocol2.read_range(13, 120, 2), spoil)
        servo.silence(False)
        while len(asked) < 3:
            rig.cycle()
        rig.cycles(10)
        assert rig.events.of(EventCode.SERVO_REBOOTED) == []
        assert "sends garbled or double replies" in rig.events.texts(EventCode.SERVO_LOST)[-1]
    assert len(asked) == 4
    assert len(rig.events.of(EventCode.SERVO_REBOOTED)) == rebooted
    assert rig.events.sources(EventCode.SERVO_LIMP) == ["arm_13_joint"]


@pytest.mark.parametrize(
    ("times_s", "latched"),
    [
        ((0.0, 60.0), (False, True)),
        ((0.0, 60.1), (False, False)),
        ((0.0, 61.0, 90.0, 95.0), (False, False, True, False)),  # it is told once
    ],
)
def test_two_reboots_latch_a_servo_only_within_a_minute(times_s, latched):
    count = RebootCount()
    assert tuple(count.count_reboot(round(at_s * 1e9)) for at_s in times_s) == latched
    assert count.exhausted == any(latched)


@pytest.mark.parametrize("plan", [make_plan((1, 3, 5)), make_x((11, 12, 13, 14))], ids=["1.0", "2.0"])
def test_servos_of_a_bus_that_is_back_are_looked_at_again_before_they_get_a_goal(plan):
    rig = start_rig(plan)
    rig.restless = 0.002  # each goal is sent in every cycle
    rig.cycles(3)
    rig.buses[0].unplug()
    rig.cycles(1)  # too short for any servo to be lost
    rig.buses[0].plug_in()
    count = len(rig.into_bus())
    rig.cycles(30)
    since = rig.into_bus()[count:]
    assert all(rig.torque())
    for servo in plan.servos:
        one = servo.servo_id
        asks_model = bytes((one, 4, 2, 0)) if plan.protocol == 1.0 else bytes((one, 7, 0, 2, 0, 0))
        looks = [asks_model in packet for packet in since]
        goals = [one in (goals_in(packet, plan.protocol) or (0, []))[1] for packet in since]
        assert True in looks[: goals.index(True)], "it got a goal before its model was read"


@pytest.mark.parametrize("hears_stop", [True, False])
def test_returned_wheel_is_given_torque_at_rest(hears_stop):
    """It must not resume its speed before the loop has anchored it, whether it received the stop or not."""
    rig = start_rig(make_x((11,), continuous=True, start_mode=Mode.VELOCITY))
    rig.anchors = False
    rig.goals.velocity[:] = 0.5
    rig.cycles(20)
    servo = rig.servo(11)
    assert servo.registers["goal_velocity"] != 0
    with rig.away(11, cycles=10):
        if hears_stop:
            servo.poke("goal_velocity", 0)
    rig.cycles(20)
    assert servo.registers["goal_velocity"] == 0
    assert rig.states.torque.tolist() == [Torque.GIVEN]
    ((_, text),) = rig.events.of(EventCode.SERVO_BACK)
    assert text.endswith("and holds its position")


def tick(value, sent_ns, last_ns=None):
    data = (value % 32768).to_bytes(2, "little")
    return TickReading.from_reply(
        Reply(TransactionOutcome.OK, 0, data, last_ns or sent_ns, 0, False, sent_ns, sent_ns)
    )


@pytest.mark.parametrize(
    ("value", "after_ms", "rebooted"),
    [
        (31_000, 1_000, False),  # in step
        (31_039, 1_000, False),  # 2 % and 20 ms fast
        (30_961, 1_000, False),
        (31_041, 1_000, True),
        (400, 1_000, True),  # back at 0 before
        (30_000 + 15_000, 15_000, False),  # across the turn
        (100, 15_000, True),
        (100, 17_000, None),  # unseen for too long
    ],
)
def test_a_tick_shows_a_reboot(value, after_ms, rebooted):
    before = tick(30_000, 0)
    assert before.rebooted(None) is None
    assert tick(value, after_ms * 1_000_000).rebooted(before) is rebooted


def test_a_reply_that_was_long_under_way_is_no_reboot():
    assert tick(1_000, 1_000_000_000, 1_150_000_000).rebooted(tick(0, 0)) is False


def test_stop_with_a_silent_servo_limps_those_behind_it_at_once():
    rig = start_rig()
    rig.servo(4).silence()
    start = rig.clock.now_ns()
    assert len(rig.hardware.stop()) == 1
    last = protocol1.write_range(21, 24, b"\0")
    off_ns = next(e.t_ns for e in rig.ledger.entries if e.t_ns >= start and e.data == last)
    assert off_ns - start < 50_000_000
    assert rig.clock.now_ns() - start < 400_000_000
