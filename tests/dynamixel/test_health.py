"""Servos that are lost, reboot and come back: judged by the simulated bus."""

from functools import partial

import pytest
from msgspec.structs import replace
from tests.kit.line_faults import truncate_next, turn_by_hand
from tests.kit.rigs import every_servo, goals_in, make_plan, make_x, start_rig

from dxlrun.channels.cycle import Torque
from dxlrun.channels.event_records import EventCode
from dxlrun.dynamixel.servo.reboots import RebootCount, TickReading
from dxlwire.bus_plan import RegisterValue
from dxlwire.modes import Mode
from dxlwire.transaction import Reply, TransactionOutcome
from dxlwire.wire import protocol1, protocol2

PROTOCOLS = pytest.mark.parametrize("protocol", [1.0, 2.0])


def start(protocol=2.0, *, returning=False, watchdog=0):
    """Return a bus of three or four servos; of these 3 and 12 are the second ones."""
    plan = make_x((11, 12, 13, 14)) if protocol == 2.0 else make_plan((1, 3, 5))
    return start_rig(replace(every_servo(plan, torque_on_return=returning), watchdog_ticks=watchdog))


def reboot(rig, servo_id):
    """Let a servo start anew while it is away."""
    with rig.away(servo_id) as servo:
        servo.power_cycle()
    return servo


def test_a_lost_servo_leaves_the_exchange_and_is_asked_once_a_second():
    rig = start()
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
    ((source, text),) = rig.events.of(EventCode.SERVO_LOST)
    assert source == "arm_13_joint"
    assert "missed 4 replies in a row" in text


def test_a_lost_servo_of_protocol_1_is_pinged_too():
    rig = start(1.0)
    rig.servo(3).silence()
    rig.cycles(120)
    assert protocol1.ping(3) in rig.into_bus()


def test_a_bus_that_stands_still_for_a_moment_loses_no_servo_at_any_rate():
    """Three cycles at 500 Hz are less than a USB adapter, or a machine, stands still for now and then."""
    rig = start()
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


def test_a_servo_that_is_lost_at_a_high_rate_is_reported_with_all_that_it_missed():
    rig = start()
    rig.period_ns = 4_000_000
    rig.servo(13).silence()
    misses = 0
    while not (lost := rig.events.texts(EventCode.SERVO_LOST)):
        rig.cycle(idle=False)
        misses += 1
    assert misses > 5
    assert f"missed {misses} replies in a row" in lost[0]


def test_a_dead_servo_of_eight_costs_the_others_no_time():
    rig = start_rig(make_plan())

    def read_takes():
        before = rig.clock.now_ns()
        rig.hardware.read_states()
        return rig.clock.now_ns() - before

    healthy = read_takes()
    rig.servo(5).silence()
    rig.cycles(5)
    assert read_takes() < healthy


def test_a_servo_whose_plug_was_loose_comes_back_with_the_torque_it_kept():
    rig = start()
    with rig.away(13, 8):
        pass
    assert rig.torque() == [True] * 4
    assert rig.events.sources(EventCode.SERVO_BACK) == ["arm_13_joint"]
    assert rig.events.of(EventCode.SERVO_REBOOTED) == []
    assert 13 in rig.goals_sent()[-1][1]
    assert rig.into_bus().count(protocol2.write_range(13, 64, b"\1")) == 1, "no policy gives it torque"


@pytest.mark.parametrize("returning", [False, True])
@PROTOCOLS
def test_a_servo_that_rebooted_gets_torque_back_only_by_the_policy(returning, protocol):
    rig = start(protocol, returning=returning)
    servo = reboot(rig, rig.plans[0].servos[1].servo_id)
    assert rig.torque()[1] is returning
    assert len(rig.events.of(EventCode.SERVO_REBOOTED)) == 1
    assert len(rig.events.of(EventCode.SERVO_LIMP)) == (not returning)
    held = servo.shaft_angle
    rig.cycles(20)
    assert servo.shaft_angle == pytest.approx(held, abs=0.01)


@pytest.mark.parametrize("rebooted", [False, True])
def test_a_servo_whose_clock_was_not_read_has_not_started_anew_before_it_was(rebooted):
    """Torque enable 0 behind a garbled clock may be the answer of a second servo with its ID."""
    rig, asked = start(), []

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


def test_a_servo_that_reboots_twice_in_a_minute_gets_no_torque_again():
    rig = start(returning=True)
    for expected in (True, False):
        rig.cycles(100)
        reboot(rig, 12)
        assert rig.torque() == [True, expected, True, True]
    texts = rig.events.texts(EventCode.SERVO_REBOOTED)
    assert len(texts) == 2
    assert "rebooted twice within a minute" in texts[-1]


@pytest.mark.parametrize(
    ("times_s", "latched"),
    [
        ((0.0, 60.0), (False, True)),
        ((0.0, 60.1), (False, False)),
        ((0.0, 61.0, 122.0), (False, False, False)),
        ((0.0, 61.0, 90.0, 95.0), (False, False, True, False)),  # it is told once
    ],
)
def test_two_reboots_latch_a_servo_only_within_a_minute(times_s, latched):
    count = RebootCount()
    assert tuple(count.count_reboot(round(at_s * 1e9)) for at_s in times_s) == latched
    assert count.exhausted == any(latched)


def _goals(packet, protocol):
    """Return which servos get a goal by a packet."""
    named = goals_in(packet, protocol)
    return named[1] if named else []


@PROTOCOLS
def test_servos_of_a_bus_that_is_back_are_looked_at_again_before_they_get_a_goal(protocol):
    rig = start(protocol)
    rig.restless = 0.002  # each goal is sent in every cycle
    rig.cycles(3)
    rig.buses[0].unplug()
    rig.cycles(1)  # too short for any servo to be lost
    rig.buses[0].plug_in()
    count = len(rig.into_bus())
    rig.cycles(30)
    since = rig.into_bus()[count:]
    assert all(rig.torque())
    for servo in rig.plans[0].servos:
        one = servo.servo_id
        asks_model = bytes((one, 4, 2, 0)) if protocol == 1.0 else bytes((one, 7, 0, 2, 0, 0))
        looks = [asks_model in packet for packet in since]
        goals = [one in _goals(packet, protocol) for packet in since]
        assert True in goals
        assert True in looks[: goals.index(True)], "it got a goal before its model was read"


@PROTOCOLS
def test_a_servo_of_a_group_that_was_let_go_gets_no_torque_when_it_is_back(protocol):
    """Not even for a moment: it would catch a limb that a person holds in the hand."""
    rig = start(protocol, returning=True)
    servo_id = rig.plans[0].servos[1].servo_id
    with rig.away(servo_id, 20) as servo:
        rig.hardware.switch_torque(1, False)
        servo.power_cycle()
        given = rig.torque_given(servo_id)
    assert not any(given)
    assert rig.torque() == [index != 1 for index in range(len(rig.buses[0].servos))]


def test_a_servo_that_was_turned_out_of_its_limits_while_it_was_away_gets_no_torque():
    rig = start(returning=True)
    plan = rig.plans[0].servos[2]
    with rig.away(13, 20) as servo:
        servo.power_cycle()
        turn_by_hand(servo, (plan.upper_tick + 30) * plan.rad_per_tick)
        servo.silence(False)
        rig.cycles(100)
        assert rig.torque() == [True, True, False, True]
        assert "outside its limits" in rig.events.texts(EventCode.SERVO_LOST)[-1]
        turn_by_hand(servo, plan.upper_tick * plan.rad_per_tick)
    assert rig.torque() == [True] * 4


def _answer_no_third_question_for_torque(rig):
    """The first two are those of the inspection and of the mode."""
    asked = []

    def spoil():
        asked.append(rig.clock.now_ns())
        if 3 <= len(asked) <= 5:
            truncate_next(rig.buses[0], 13, 0)

    rig.when(lambda data: data == protocol2.read_range(13, 64, 1), spoil)


@pytest.mark.parametrize(
    ("trick", "said"),
    [
        (lambda rig: rig.stick(13, "torque_enable", 0), "and torque enable 0"),
        (_answer_no_third_question_for_torque, "did not answer when its torque was read"),
        (lambda rig: rig.stick(13, "bus_watchdog", 0), "has Bus Watchdog (98) = 0 after 10 was written"),
        (lambda rig: rig.servo(13).trigger_overload(), "overload error"),
    ],
)
def test_a_servo_that_is_not_certain_to_be_in_order_does_not_come_back_and_is_reported_once(trick, said):
    rig = start(returning=True, watchdog=10)
    servo = rig.servo(13)
    servo.silence()
    rig.cycles(20)
    servo.power_cycle()
    trick(rig)
    servo.silence(False)
    while len(rig.events.of(EventCode.SERVO_LOST)) < 2:
        assert not rig.events.of(EventCode.SERVO_BACK)
        rig.cycle()
    assert rig.states.valid.tolist() == [True, True, False, True]
    _, text = rig.events.texts(EventCode.SERVO_LOST)
    assert "is not ready" in text
    assert said in text
    if "overload" in said:  # which lasts
        rig.cycles(200)
        assert len(rig.events.of(EventCode.SERVO_LOST)) == 2


def test_registers_that_a_reboot_took_are_written_again():
    gain = RegisterValue(84, 2, 555, "position_p_gain")
    rig = start_rig(every_servo(make_x((11, 12, 13, 14)), settings=(gain,)))
    assert rig.registers(gain.name) == [555] * 4
    with rig.away(13) as servo:
        servo.power_cycle()
        assert servo.registers[gain.name] != 555
    assert servo.registers[gain.name] == 555
    assert len(rig.events.of(EventCode.REGISTER_WRITTEN)) == 5


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


def test_returned_servo_reports_settings_that_differ_but_those_of_the_run():
    gain = RegisterValue(84, 2, 555, "position_p_gain")
    rig = start_rig(every_servo(make_x((11, 12)), settings=(gain,)))
    with rig.away(12) as servo:
        servo.poke("temperature_limit", 70)
    ((joint, text),) = rig.events.of(EventCode.REGISTER_DIFFERS)
    assert joint == "arm_12_joint"
    assert "Temperature Limit (31) = 70" in text
    assert "Gain" not in text


def _tick(tick, sent_ns, last_ns=None):
    last_ns = sent_ns if last_ns is None else last_ns
    return Reply(
        TransactionOutcome.OK, 0, (tick % 32768).to_bytes(2, "little"), last_ns, 0, False, sent_ns, sent_ns
    )


@pytest.mark.parametrize(
    ("tick", "after_ms", "rebooted"),
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
def test_a_tick_shows_a_reboot(tick, after_ms, rebooted):
    before = TickReading.from_reply(_tick(30_000, 0))
    assert before.rebooted(None) is None
    assert TickReading.from_reply(_tick(tick, after_ms * 1_000_000)).rebooted(before) is rebooted


def test_a_reply_that_was_long_under_way_is_no_reboot():
    before = TickReading.from_reply(_tick(0, 0))
    assert TickReading.from_reply(_tick(1_000, 1_000_000_000, 1_150_000_000)).rebooted(before) is False


def test_torque_that_was_cut_without_a_reboot_is_not_given_back():
    """Another program, or a hand at a tool, switched it off."""
    rig = start(returning=True)
    with rig.away(13, 20) as servo:
        servo.poke("torque_enable", 0)
    assert rig.torque() == [True, True, False, True]
    assert rig.events.of(EventCode.SERVO_REBOOTED) == []


def test_a_servo_of_protocol_1_that_was_limp_before_it_was_lost_did_not_reboot():
    """It has no clock: only torque that it had and has no more tells a reboot."""
    rig = start(1.0)
    reboot(rig, 3)
    with rig.away(3, 20):
        pass
    assert rig.torque() == [True, False, True]
    assert len(rig.events.of(EventCode.SERVO_REBOOTED)) == 1


def test_a_servo_of_protocol_1_that_was_let_go_gets_no_goal_which_would_switch_its_torque_on():
    rig = start(1.0)
    rig.restless = 0.02
    rig.cycles(3)
    rig.hardware.switch_torque(1, False)
    since = len(rig.into_bus())
    rig.cycles(30)
    assert rig.torque() == [True, False, True]
    assert [ids for _, ids in rig.goals_sent(since)] == [[1, 5]] * 30


def test_an_end_without_a_line_raises_nothing_and_names_every_servo():
    rig = start(watchdog=10)
    rig.cycles(3)
    rig.buses[0].unplug()
    said = rig.hardware.stop()
    assert len(said) == 4
    assert all("torque off could not be sent" in sentence for sentence in said)
