"""Servos that are lost, reboot, come back, and what the Bus Watchdog does: judged by the simulated bus."""

import math
import re
from functools import partial

import pytest
from msgspec.structs import replace
from tests.kit import rigs
from tests.kit.rigs import goals_in, make_plan, make_rig, start_rig

from dxlrun.channels.events import EventCode
from dxlrun.dynamixel.control_table import control_table
from dxlrun.dynamixel.servo import watchdog
from dxlrun.dynamixel.servo.reboots import RealtimeTicks, RebootCount
from dxlrun.dynamixel.servo.watchdog import RETURN_SPEED
from dxlrun.dynamixel.wire import protocol1, protocol2
from dxlrun.errors import StartUpError
from dxlrun.plan.bus_plan import RegisterValue
from dxlrun.plan.transaction import Outcome, Reply

X_IDS = (11, 12, 13, 14)


def make_x(ids=(11, 12, 13, 14), *, returning=False, watchdog=0, **change):
    return _with(rigs.make_x(ids, **change), returning, watchdog)


def _with(plan, returning, watchdog=0):
    servos = tuple(replace(servo, torque_on_return=returning) for servo in plan.servos)
    return replace(plan, servos=servos, watchdog_ticks=watchdog)


def test_a_lost_servo_leaves_the_exchange_and_is_asked_once_a_second():
    rig = start_rig(make_x())
    rig.buses[0].servo(13).silence()
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


def test_a_bus_that_stands_still_for_a_moment_loses_no_servo_at_any_rate():
    """Three cycles at 500 Hz are less than a USB adapter, or a machine, stands still for now and then."""
    rig = start_rig(make_x())
    begun = rig.clock.now_ns()
    for servo in rig.buses[0].servos:
        servo.silence()
        rig.buses[0].at(begun + 40_000_000, partial(servo.silence, False))
        rig.buses[0].at(begun + 200_000_000, servo.silence)
    missed = 0
    while not (lost := rig.events.of(EventCode.SERVO_LOST)):
        rig.hardware.read()
        rig.hardware.write()
        missed += not rig.states.valid.any()
        rig.clock.wait_until(rig.clock.now_ns() + 1_000_000)
    assert 250_000_000 <= rig.clock.now_ns() - begun < 280_000_000
    assert missed > 2 * 3
    assert len(lost) >= 1
    assert len(rig.events.of(EventCode.READ_BACK)) == 4


def test_a_dead_servo_of_eight_costs_the_others_no_time():
    rig = start_rig(make_plan())
    before = rig.clock.now_ns()
    rig.hardware.read()
    healthy = rig.clock.now_ns() - before
    rig.buses[0].servo(5).silence()
    rig.cycles(5)
    before = rig.clock.now_ns()
    rig.hardware.read()
    assert rig.clock.now_ns() - before < healthy


def test_a_servo_whose_plug_was_loose_comes_back_with_the_torque_it_kept():
    rig = start_rig(make_x())
    servo = rig.buses[0].servo(13)
    servo.silence()
    rig.cycles(8)
    servo.silence(False)
    rig.until_valid()
    rig.cycles(3)
    assert rig.torque() == [True] * 4
    assert [source for source, _ in rig.events.of(EventCode.SERVO_BACK)] == ["arm_13_joint"]
    assert rig.events.of(EventCode.SERVO_REBOOTED) == []
    torque_on = protocol2.write(13, 64, b"\1")
    goals = [packet for packet in rig.into_bus() if packet[7] == 0x83][-1]
    assert 13 in goals[12:-2:9]
    assert rig.into_bus().count(torque_on) == 1, "torque was written to a servo that no policy gives it"


@pytest.mark.parametrize("returning", [False, True])
@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_a_servo_that_rebooted_gets_torque_back_only_by_the_policy(returning, protocol):
    rig = start_rig(
        make_x(returning=returning) if protocol == 2.0 else _with(make_plan((1, 3, 5)), returning)
    )
    servo = rig.buses[0].servos[1]
    servo.silence()
    rig.cycles(4)
    servo.reset()
    servo.silence(False)
    assert rig.torque()[1] is False
    rig.until_valid()
    rig.cycles(5)
    assert rig.torque()[1] is returning
    assert len(rig.events.of(EventCode.SERVO_REBOOTED)) == 1
    assert len(rig.events.of(EventCode.SERVO_LIMP)) == (not returning)
    held = servo.position
    rig.cycles(20)
    assert servo.position == pytest.approx(held, abs=0.01)


@pytest.mark.parametrize("rebooted", [False, True])
def test_a_servo_whose_clock_was_not_read_has_not_started_anew_before_it_was(rebooted):
    """Torque enable 0 behind a garbled clock may be the answer of a second servo with its ID."""
    rig = start_rig(make_x())
    servo = rig.buses[0].servo(13)
    servo.silence()
    rig.cycles(5)
    if rebooted:
        servo.reset()
    servo.poke("torque_enable", 0)
    servo.silence(False)
    write, asked = rig.ports.ports[0].write, []

    def through(data):
        if data == protocol2.read(13, 120, 2):
            asked.append(data)
            if len(asked) <= 3:
                rig.buses[0].truncate_next(13, 5)
        write(data)

    rig.ports.ports[0].write = through
    while len(asked) < 3:
        rig.cycle()
    rig.cycles(10)
    assert rig.events.of(EventCode.SERVO_REBOOTED) == []
    assert "answers garbled or twice" in rig.events.of(EventCode.SERVO_LOST)[-1][1]
    rig.until_valid()
    assert len(asked) == 4
    assert len(rig.events.of(EventCode.SERVO_REBOOTED)) == rebooted
    assert [source for source, _ in rig.events.of(EventCode.SERVO_LIMP)] == ["arm_13_joint"]


def test_a_servo_that_reboots_twice_in_a_minute_gets_no_torque_again():
    rig = start_rig(make_x(returning=True))
    servo = rig.buses[0].servo(12)
    for expected in (True, False):
        rig.cycles(100)
        servo.silence()
        rig.cycles(4)
        servo.reset()
        servo.silence(False)
        rig.until_valid()
        rig.cycles(5)
        assert rig.torque() == [True, expected, True, True]
    texts = [text for _, text in rig.events.of(EventCode.SERVO_REBOOTED)]
    assert len(texts) == 3
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
    count = RebootCount(2)
    assert tuple(count.add(1, round(at_s * 1e9)) for at_s in times_s) == latched
    assert count.exhausted == [False, any(latched)]


def _reads_model(packet, protocol):
    """Return whose model number a packet asks for, -1: nobody's."""
    if protocol == 1.0:
        return packet[2] if packet[4:6] == b"\x02\x00" else -1
    return packet[4] if packet[7:10] == b"\x02\x00\x00" else -1


def _goals(packet, protocol):
    """Return who gets a goal by a packet."""
    named = goals_in(packet, protocol)
    return named[1] if named else []


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_servos_of_a_bus_that_is_back_are_looked_at_again_before_they_get_a_goal(protocol):
    rig = start_rig(make_x() if protocol == 2.0 else make_plan((1, 3, 5)))
    rig.restless = 0.002  # each goal is sent in every cycle
    rig.cycles(3)
    rig.buses[0].unplug()
    rig.cycles(1)  # too short for any servo to be lost
    rig.buses[0].plug_in()
    count = len(rig.into_bus())
    rig.cycles(30)
    since = rig.into_bus()[count:]
    assert rig.torque() == [True] * len(rig.states.valid)
    for servo in rig.plans[0].servos:
        looks = [_reads_model(packet, protocol) == servo.servo_id for packet in since]
        goals = [servo.servo_id in _goals(packet, protocol) for packet in since]
        assert True in goals
        assert True in looks[: goals.index(True)], "it got a goal before its model was read"


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_a_servo_of_a_group_that_was_let_go_gets_no_torque_when_it_is_back(protocol):
    """Not even for a moment: it would catch a limb that a person holds in the hand."""
    rig = start_rig(make_x(returning=True) if protocol == 2.0 else _with(make_plan((1, 3, 5)), True))
    servo = rig.buses[0].servos[1]
    servo.silence()
    rig.cycles(20)
    rig.hardware.switch_torque(1, False)
    servo.reset()
    servo.silence(False)
    given = []
    servo.registers.watch(("torque_enable",), lambda: given.append(servo.registers["torque_enable"]))
    rig.until_valid()
    rig.cycles(5)
    assert not any(given)
    assert rig.torque() == [index != 1 for index in range(len(rig.buses[0].servos))]


def test_a_servo_that_was_turned_out_of_its_limits_while_it_was_away_gets_no_torque():
    rig = start_rig(make_x(returning=True))
    servo, plan = rig.buses[0].servo(13), rig.plans[0].servos[2]
    servo.silence()
    rig.cycles(20)
    servo.reset()
    servo.turn_by_hand((plan.upper_tick + 30) * plan.rad_per_tick)
    servo.silence(False)
    rig.cycles(100)
    assert rig.torque() == [True, True, False, True]
    assert "outside its limits" in rig.events.of(EventCode.SERVO_LOST)[-1][1]
    servo.turn_by_hand(plan.upper_tick * plan.rad_per_tick)
    rig.cycles(60)
    assert rig.torque() == [True] * 4


def _refuse_torque(rig, servo):
    servo.registers.watch(("torque_enable",), lambda: servo.poke("torque_enable", 0))


def _refuse_watchdog(rig, servo):
    servo.registers.watch(("bus_watchdog",), lambda: servo.poke("bus_watchdog", 0))


def _answer_no_third_question_for_torque(rig, servo):
    """The first two are those of the inspection and of the mode."""
    write, asked = rig.ports.ports[0].write, []

    def through(data):
        if data == protocol2.read(servo.servo_id, 64, 1):
            asked.append(data)
            if 3 <= len(asked) <= 5:
                rig.buses[0].truncate_next(servo.servo_id, 0)
        write(data)

    rig.ports.ports[0].write = through


@pytest.mark.parametrize(
    ("trick", "said"),
    [
        (_refuse_torque, "and torque enable 0"),
        (_answer_no_third_question_for_torque, "did not answer when its torque was read"),
        (_refuse_watchdog, "was given Bus Watchdog (98) = 10, but has 0"),
    ],
)
def test_a_servo_whose_torque_is_not_certain_does_not_come_back(trick, said):
    rig = start_rig(make_x(returning=True, watchdog=10))
    servo = rig.buses[0].servo(13)
    servo.silence()
    rig.cycles(20)
    servo.reset()
    trick(rig, servo)
    servo.silence(False)
    while len(texts := [text for _, text in rig.events.of(EventCode.SERVO_LOST)]) < 2:
        assert not rig.events.of(EventCode.SERVO_BACK)
        rig.cycle()
    assert "cannot take part" in texts[1]
    assert said in texts[1]
    assert not rig.states.valid[2]


def _answer_for_the_watchdog_once(rig, servo):
    write, asked = rig.ports.ports[0].write, []

    def through(data):
        if data == protocol2.read(servo.servo_id, 98, 1):
            asked.append(data)
            if len(asked) > 1:
                rig.buses[0].truncate_next(servo.servo_id, 0)
        write(data)

    rig.ports.ports[0].write = through


@pytest.mark.parametrize(
    ("trick", "said"),
    [
        (_refuse_watchdog, "was given Bus Watchdog (98) = 10, but has 0"),
        (_answer_for_the_watchdog_once, "did not answer when its Bus Watchdog (98) was read back"),
    ],
)
def test_a_watchdog_that_is_not_certain_to_be_armed_ends_the_start(trick, said):
    rig = make_rig(make_x(watchdog=10))
    trick(rig, rig.buses[0].servo(12))
    with pytest.raises(StartUpError, match=re.escape(f"ID 12 on bus arm) {said}")):
        rig.hardware.start()
    assert rig.torque() == [False] * 4


def test_registers_that_a_reboot_took_are_written_again():
    from dxlrun.plan.bus_plan import RegisterValue

    plan = make_x()
    gain = RegisterValue(84, 2, 555, "position_p_gain")
    plan = replace(plan, servos=tuple(replace(servo, registers=(gain,)) for servo in plan.servos))
    rig = start_rig(plan)
    servo = rig.buses[0].servo(13)
    assert servo.registers["position_p_gain"] == 555
    servo.silence()
    rig.cycles(4)
    servo.reset()
    servo.silence(False)
    assert servo.registers["position_p_gain"] != 555
    rig.until_valid()
    assert servo.registers["position_p_gain"] == 555
    assert len(rig.events.of(EventCode.REGISTER_WRITTEN)) == 5


def test_a_servo_with_a_hardware_error_does_not_come_back_and_is_reported_once():
    rig = start_rig(make_x(returning=True))
    servo = rig.buses[0].servo(13)
    servo.silence()
    rig.cycles(4)
    servo.trigger_overload()
    servo.silence(False)
    rig.cycles(250)
    assert rig.states.valid.tolist() == [True, True, False, True]
    texts = [text for _, text in rig.events.of(EventCode.SERVO_LOST)]
    assert len(texts) == 2
    assert "cannot take part" in texts[1]
    assert "overload error" in texts[1]


def test_the_watchdog_is_armed_at_the_start_and_disarmed_at_the_end():
    rig = start_rig(make_x(watchdog=10))
    assert [servo.registers["bus_watchdog"] for servo in rig.buses[0].servos] == [10] * 4
    rig.cycles(50)
    assert rig.events.of(EventCode.WATCHDOG) == []
    rig.hardware.stop()
    rig.torque()
    assert [servo.registers["bus_watchdog"] for servo in rig.buses[0].servos] == [0] * 4


def test_a_servo_that_is_lost_at_a_high_rate_is_reported_with_all_that_it_missed():
    rig = start_rig(make_x())
    rig.period_ns = 4_000_000
    rig.buses[0].servo(13).silence()
    misses = 0
    while not (lost := rig.events.of(EventCode.SERVO_LOST)):
        rig.cycle(idle=False)
        misses += 1
    assert misses > 5
    assert f"missed {misses} replies in a row" in lost[0][1]


def _once_armed(rig, servo_id, what):
    """Do something as soon as a servo's watchdog is armed, once."""
    servo, left = rig.buses[0].servo(servo_id), [what]

    def written():
        if servo.registers["bus_watchdog"] == 10 and left:
            left.pop()(servo_id)

    servo.registers.watch(("bus_watchdog",), written)


def test_no_servo_is_stopped_because_the_answers_of_others_are_lost_while_they_are_armed():
    rig = make_rig(make_x(watchdog=10))
    _once_armed(rig, 14, lambda servo_id: rig.buses[0].truncate_next(servo_id, 0))
    rig.hardware.start()
    rig.goals.position[:] = 0.5
    rig.cycles(100)
    assert [servo.registers["bus_watchdog"] for servo in rig.buses[0].servos] == [10] * 4
    assert rig.states.position == pytest.approx(0.5, abs=0.01)
    assert rig.events.of(EventCode.WATCHDOG) == []


def test_no_servo_is_stopped_because_the_adapter_is_slow_while_they_are_armed():
    rig = make_rig(make_x(range(11, 23), watchdog=10))
    for servo_id in range(11, 23):
        _once_armed(rig, servo_id, lambda one: rig.buses[0].delay_next(one, 60_000_000))
    rig.hardware.start()
    assert [servo.registers["bus_watchdog"] for servo in rig.buses[0].servos] == [10] * 12
    assert rig.events.of(EventCode.WATCHDOG) == []


def test_no_watchdog_is_taken_for_tripped_before_it_was_armed():
    """The first states are read once more after a pause that is longer than the watchdogs."""
    rig = make_rig(make_x(watchdog=2))
    read = rig.hardware.read

    def spoilt():
        rig.buses[0].truncate_next(rig.plans[0].servos[0].servo_id, 4)
        rig.hardware.read = read
        read()

    rig.hardware.read = spoilt
    rig.hardware.start()
    assert rig.events.of(EventCode.READ_LOST)
    assert rig.events.of(EventCode.WATCHDOG) == []
    assert all(
        map(math.isnan, rig.hardware._servos[0].life.ceiling)
    )  # goals are followed as fast as they say


def test_a_servo_that_was_stopped_while_others_were_armed_is_revived():
    rig = make_rig(make_x(watchdog=10))
    _once_armed(rig, 14, lambda one: [rig.buses[0].truncate_next(one, 0) for _ in range(3)])
    rig.hardware.start()
    assert rig.buses[0].servo(11).registers["bus_watchdog"] == 0xFF
    rig.goals.position[:] = 0.5
    rig.cycles(100)
    assert [servo.registers["bus_watchdog"] for servo in rig.buses[0].servos] == [10] * 4
    assert rig.states.position == pytest.approx(0.5, abs=0.01)
    assert len(rig.events.of(EventCode.WATCHDOG)) == 1


def test_servos_that_are_left_holding_are_not_stopped_by_the_watchdog():
    rig = start_rig(make_x(watchdog=10))
    rig.cycles(5)
    rig.hardware.release()
    rig.clock.wait_until(rig.clock.now_ns() + 1_000_000_000)
    assert rig.torque() == [True] * 4
    assert [servo.registers["bus_watchdog"] for servo in rig.buses[0].servos] == [0] * 4


def _wait(rig, duration_ns):
    rig.clock.wait_until(rig.clock.now_ns() + duration_ns)
    rig.torque()


def test_servos_that_their_watchdogs_have_stopped_stay_stopped_when_they_are_left_holding():
    rig = start_rig(make_x(watchdog=10))
    servos = rig.buses[0].servos
    _stopped_on_a_long_way(rig, servos[1])
    _wait(rig, 300_000_000)
    stood = [servo.position for servo in servos]
    rig.hardware.release()
    _wait(rig, 2_000_000_000)
    assert [servo.position for servo in servos] == pytest.approx(stood, abs=0.002)
    assert [servo.registers["bus_watchdog"] for servo in servos] == [0xFF] * 4
    told = [text for _, text in rig.events.of(EventCode.WATCHDOG)]
    assert len(told) == 4
    assert "arm_12_joint (ID 12 on bus arm) was stopped by its Bus Watchdog (98)" in told[1]


def test_one_stopped_servo_among_others_that_are_left_holding_stays_stopped():
    rig = start_rig(make_x(watchdog=10))
    servos = rig.buses[0].servos
    _stopped_on_a_long_way(rig, servos[1])
    for name, value in (("profile_velocity", 0), ("profile_acceleration", 0), ("bus_watchdog", -1)):
        servos[1].poke(name, value)
    _wait(rig, 100_000_000)
    stood = servos[1].position
    rig.hardware.release()
    _wait(rig, 1_000_000_000)
    assert [servo.registers["bus_watchdog"] for servo in servos] == [0, 0xFF, 0, 0]
    assert servos[1].position == pytest.approx(stood, abs=0.002)


def test_no_servo_is_stopped_because_others_are_silent_when_all_are_left_holding():
    rig = start_rig(make_x(range(11, 23), watchdog=10))
    rig.cycles(5)
    servos = rig.buses[0].servos
    servos[3].silence()
    rig.hardware.release()
    _wait(rig, 1_000_000_000)
    armed = [servo.registers["bus_watchdog"] for servo in servos]
    assert armed == [0, 0, 0, 0xFF] + [0] * 8
    (told,) = [text for _, text in rig.events.of(EventCode.WATCHDOG)]
    assert "arm_14_joint (ID 14 on bus arm) did not answer when its Bus Watchdog (98) was read" in told


def test_no_servo_is_stopped_because_disarming_all_takes_longer_than_a_watchdog():
    rig = start_rig(_with(make_plan(range(1, 25), protocol=2.0, model="XM430-W350"), False, watchdog=2))
    rig.period_ns = 25_000_000
    rig.cycles(5)
    assert [servo.registers["bus_watchdog"] for servo in rig.buses[0].servos] == [2] * 24
    told = rig.events.of(EventCode.WATCHDOG)
    rig.hardware.release()
    _wait(rig, 1_000_000_000)
    assert [servo.registers["bus_watchdog"] for servo in rig.buses[0].servos] == [0] * 24
    assert rig.events.of(EventCode.WATCHDOG) == told


def test_a_servo_whose_torque_could_not_be_switched_off_keeps_its_watchdog():
    rig = start_rig(make_x(watchdog=10))
    servos = rig.buses[0].servos
    _stopped_on_a_long_way(rig, servos[1])
    servos[1].registers.watch(("torque_enable",), lambda: servos[1].poke("torque_enable", 1))
    assert len(rig.hardware.stop()) == 1
    _wait(rig, 1_000_000_000)
    assert [servo.registers["bus_watchdog"] for servo in servos] == [0, 0xFF, 0, 0]


def test_a_loop_that_was_silent_for_too_long_revives_the_servos_that_stopped():
    rig = start_rig(make_x(watchdog=10))
    rig.cycles(5)
    rig.clock.wait_until(rig.clock.now_ns() + 300_000_000)
    rig.torque()
    stopped = [servo.registers["bus_watchdog"] for servo in rig.buses[0].servos]
    assert stopped == [0xFF] * 4
    rig.goals.position[:] = 0.2
    rig.cycles(100)
    assert [servo.registers["bus_watchdog"] for servo in rig.buses[0].servos] == [10] * 4
    assert rig.states.position == pytest.approx(0.2, abs=0.01)
    ((source, text),) = rig.events.of(EventCode.WATCHDOG)
    assert source == "arm"
    assert "the Bus Watchdog has stopped the servos" in text
    rig.clock.wait_until(rig.clock.now_ns() + 300_000_000)
    rig.cycles(100)
    assert [servo.registers["bus_watchdog"] for servo in rig.buses[0].servos] == [10] * 4, "the second time"


def test_a_ramp_that_the_watchdog_reset_is_written_again():
    plan = make_x(watchdog=10)
    item = control_table("XM430-W350").items["profile_acceleration"]
    ramp = RegisterValue(item.address, item.size, 100, item.name)
    rig = start_rig(replace(plan, servos=tuple(replace(servo, registers=(ramp,)) for servo in plan.servos)))
    rig.cycles(5)
    rig.clock.wait_until(rig.clock.now_ns() + 300_000_000)
    rig.torque()
    assert [servo.registers["profile_acceleration"] for servo in rig.buses[0].servos] == [0] * 4
    rig.cycles(100)
    assert [servo.registers["profile_acceleration"] for servo in rig.buses[0].servos] == [100] * 4
    assert [servo.registers["bus_watchdog"] for servo in rig.buses[0].servos] == [10] * 4
    written = [text for _, text in rig.events.of(EventCode.REGISTER_WRITTEN)]
    assert written[-4:] == ["Profile Acceleration (108) was 0 and is 100"] * 4


def _fastest(rig, servo, count):
    """Return the highest speed of a servo in the next cycles, rad/s."""
    speeds = []
    for _ in range(count):
        rig.cycle()
        speeds.append(abs(servo.velocity))
    return max(speeds)


def _stopped_on_a_long_way(rig, servo):
    """Let the watchdogs stop all servos on a slow way of 2 rad."""
    rig.goals.position[:], rig.goals.velocity[:] = 2.0, 0.2
    rig.cycles(5)
    assert 0.1 < abs(servo.velocity) < 0.25


def test_a_servo_that_is_revived_goes_on_slowly_though_its_profile_was_reset():
    rig = start_rig(make_x(watchdog=10))
    servo = rig.buses[0].servo(12)
    _stopped_on_a_long_way(rig, servo)
    rig.clock.wait_until(rig.clock.now_ns() + 300_000_000)
    rig.torque()
    assert (servo.registers["bus_watchdog"], servo.registers["profile_velocity"]) == (0xFF, 0)
    rig.goals.velocity[:] = 10.0
    assert 0.5 < _fastest(rig, servo, 50) < 1.1 * RETURN_SPEED
    assert servo.registers["bus_watchdog"] == 10


def test_a_lost_servo_that_is_back_goes_on_slowly_though_its_profile_was_reset():
    rig = start_rig(make_x(watchdog=10))
    servo = rig.buses[0].servo(12)
    _stopped_on_a_long_way(rig, servo)
    servo.silence()
    rig.cycles(5)
    for name, value in (("profile_velocity", 0), ("profile_acceleration", 0), ("bus_watchdog", -1)):
        servo.poke(name, value)  # as the reset of a watchdog that heard nothing leaves it
    servo.silence(False)
    assert _fastest(rig, servo, 150) < 1.1 * RETURN_SPEED
    assert servo.registers["bus_watchdog"] == 10


@pytest.mark.parametrize("watchdog", [10, 0])
def test_a_watchdog_that_an_earlier_run_left_is_cleared(watchdog):
    rig = make_rig(make_x(watchdog=watchdog))
    rig.buses[0].servo(12).poke("bus_watchdog", -1)
    rig.hardware.start()
    assert rig.torque() == [True] * 4


@pytest.mark.parametrize(
    ("reply", "said"),
    [
        (
            Reply(Outcome.TIMEOUT, 0, b"", 0, 0, False),
            "did not answer when its Bus Watchdog (98) was read back",
        ),
        (Reply(Outcome.OK, 0, b"\x0a", 0, 0, False), "was given Bus Watchdog (98) = 0, but has 10"),
    ],
)
def test_a_watchdog_that_is_not_read_as_0_is_written_and_is_not_cleared(reply, said):
    plan = make_x(watchdog=10)
    program = watchdog.disarm(plan, plan.servos[0])
    sent = [next(program).packet]

    def go_on():
        while True:
            sent.append(program.send(reply).packet)

    with pytest.raises(StopIteration) as end:
        go_on()
    assert protocol2.write(plan.servos[0].servo_id, 98, b"\0") in sent
    assert said in end.value.value


@pytest.mark.parametrize(
    ("silent", "written", "said"),
    [
        (None, {112, 98, 104}, ""),
        (11, {112}, "did not answer when its Operating Mode (11) was read"),
        (104, {112, 98, 104, 64}, "did not acknowledge Goal Velocity (104) = 0"),
    ],
)
def test_a_servo_that_follows_velocities_is_freed_of_its_watchdog_only_to_stand(silent, written, said):
    plan = make_x(watchdog=10)
    program, found = watchdog.disarm(plan, plan.servos[0]), {}

    def go_on(transaction):
        while True:
            packet = transaction.packet
            address = int.from_bytes(packet[8:10], "little")
            if packet[7] == 3:
                found[address] = packet[10:-2]
            data = b"" if packet[7] == 3 else b"\1\xff" if address == 11 else found.get(98, b"\xff")
            outcome = Outcome.TIMEOUT if address == silent else Outcome.OK
            transaction = program.send(Reply(outcome, 0, data, 0, 0, False))

    with pytest.raises(StopIteration) as end:
        go_on(next(program))
    assert said in end.value.value
    assert bool(end.value.value) == bool(said)
    assert set(found) == written
    assert all(not any(data) for address, data in found.items() if address != 112)


def test_a_lost_servo_that_its_watchdog_stopped_comes_back():
    rig = start_rig(make_x(watchdog=10, returning=True))
    servo = rig.buses[0].servo(13)
    servo.silence()
    rig.cycles(30)
    servo.poke("bus_watchdog", -1)
    servo.silence(False)
    rig.until_valid()
    assert servo.registers["bus_watchdog"] == 10
    assert rig.torque() == [True] * 4


def _tick(tick, sent_ns, last_ns=None):
    last_ns = sent_ns if last_ns is None else last_ns
    return Reply(Outcome.OK, 0, (tick % 32768).to_bytes(2, "little"), last_ns, 0, False, sent_ns)


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
    ticks = RealtimeTicks(1)
    assert ticks.rebooted(0, _tick(30_000, 0)) is None
    assert ticks.rebooted(0, _tick(tick, after_ms * 1_000_000)) is rebooted


def test_a_reply_that_was_long_under_way_is_no_reboot():
    ticks = RealtimeTicks(1)
    ticks.rebooted(0, _tick(0, 0))
    assert ticks.rebooted(0, _tick(1_000, 1_000_000_000, 1_150_000_000)) is False


def test_a_ping_of_protocol_1_is_what_a_lost_servo_is_asked():
    rig = start_rig(make_plan((1, 3)))
    rig.buses[0].servo(3).silence()
    rig.cycles(120)
    assert protocol1.ping(3) in rig.into_bus()


def test_torque_that_was_cut_without_a_reboot_is_not_given_back():
    """Another program, or a hand at a tool, switched it off."""
    rig = start_rig(make_x(returning=True))
    servo = rig.buses[0].servo(13)
    servo.silence()
    rig.cycles(20)
    servo.poke("torque_enable", 0)
    servo.silence(False)
    rig.until_valid()
    rig.cycles(5)
    assert rig.torque() == [True, True, False, True]
    assert rig.events.of(EventCode.SERVO_REBOOTED) == []


def test_a_servo_of_protocol_1_that_was_limp_before_it_was_lost_did_not_reboot():
    """It has no clock: only torque that it had and has no more tells a reboot."""
    rig = start_rig(_with(make_plan((1, 3, 5)), False))
    servo = rig.buses[0].servo(3)
    for reset in (True, False):
        servo.silence()
        rig.cycles(20)
        if reset:
            servo.reset()
        servo.silence(False)
        rig.until_valid()
        rig.cycles(5)
        assert rig.torque() == [True, False, True]
    assert len(rig.events.of(EventCode.SERVO_REBOOTED)) == 1


def test_a_servo_that_its_watchdog_stopped_gets_no_goal_before_its_torque_was_read():
    rig = start_rig(make_x(watchdog=10))
    rig.restless = 0.002
    rig.cycles(5)
    rig.clock.wait_until(rig.clock.now_ns() + 300_000_000)
    count = len(rig.into_bus())
    rig.cycles(30)
    since = rig.into_bus()[count:]
    for servo_id in X_IDS:
        asked = since.index(protocol2.read(servo_id, 64, 1))
        goals = [servo_id in _goals(packet, 2.0) for packet in since]
        assert True in goals
        assert goals.index(True) > asked


def test_a_servo_of_protocol_1_that_was_let_go_gets_no_goal_which_would_switch_its_torque_on():
    rig = start_rig(make_plan((1, 3, 5)))
    rig.restless = 0.02
    rig.cycles(3)
    rig.hardware.switch_torque(1, False)
    since = len(rig.into_bus())
    rig.cycles(30)
    assert rig.torque() == [True, False, True]
    goals = [list(_goals(packet, 1.0)) for packet in rig.into_bus()[since:] if _goals(packet, 1.0)]
    assert goals == [[1, 5]] * 30


def test_an_end_without_a_line_raises_nothing_and_names_every_servo():
    rig = start_rig(make_x(watchdog=10))
    rig.cycles(3)
    rig.buses[0].unplug()
    said = rig.hardware.stop()
    assert len(said) == 4
    assert all("torque off could not be sent" in sentence for sentence in said)
