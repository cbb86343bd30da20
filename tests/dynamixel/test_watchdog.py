"""The Bus Watchdog: armed last, disarmed at the end, and what becomes of servos that it stopped."""

import math

import pytest
from msgspec.structs import replace
from tests.kit.line_faults import delay_next, truncate_next
from tests.kit.rigs import make_rig, make_x, start_rig

from dxlrun.channels.event_records import EventCode
from dxlrun.dynamixel.servo import watchdog
from dxlrun.dynamixel.servo.item_access import access_servo
from dxlrun.dynamixel.servo.watchdog import RETURN_SPEED
from dxlwire.plan.bus_watchdog import UNIT_NS
from dxlwire.transaction import Reply, TransactionOutcome
from dxlwire.wire import protocol2

TRIPPED = 0xFF
MS = 1_000_000
SECOND_NS = 1_000 * MS


def arm(ids=(11, 12, 13, 14), ticks=10, **change):
    return replace(make_x(ids, **change), watchdog_ticks=ticks)


@pytest.fixture
def started():
    return start_rig(arm())


def armed(rig):
    return rig.registers("bus_watchdog")


def once_armed(rig, servo_id, act):
    """Do something as soon as a servo's watchdog is armed, once."""
    servo, left = rig.servo(servo_id), [act]

    def written():
        if servo.registers["bus_watchdog"] == 10 and left:
            left.pop()(servo_id)

    servo.registers.watch_items(("bus_watchdog",), written)


def trip(servo):
    """Leave a servo as the reset of a watchdog that heard nothing does."""
    for name, value in (("profile_velocity", 0), ("profile_acceleration", 0), ("bus_watchdog", -1)):
        servo.poke(name, value)


def move_far(rig):
    """Begin a slow way of 2 rad."""
    rig.goals.position[:], rig.goals.velocity[:] = 2.0, 0.2
    rig.cycles(5)
    assert 0.1 < abs(rig.buses[0].servos[1].velocity) < 0.25


def fastest(rig, servo, count):
    """Return the highest speed of a servo in the next cycles, rad/s."""
    speeds = []
    for _ in range(count):
        rig.cycle()
        speeds.append(abs(servo.velocity))
    return max(speeds)


class TestWhileOthersAreArmed:
    """Arming takes an exchange a servo, in which those that are armed hear nothing of a cycle."""

    @pytest.mark.parametrize(("losses", "stopped"), [(1, 0), (3, 1)])
    def test_a_lost_answer_stops_none_and_those_that_three_stop_are_revived(self, losses, stopped):
        rig = make_rig(arm())
        once_armed(rig, 14, lambda one: [truncate_next(rig.buses[0], one, 0) for _ in range(losses)])
        rig.hardware.start()
        assert armed(rig)[0] == (TRIPPED if stopped else 10)
        rig.goals.position[:] = 0.5
        rig.cycles(100)
        assert armed(rig) == [10] * 4
        assert rig.states.position == pytest.approx(0.5, abs=0.01)
        assert len(rig.events.of(EventCode.WATCHDOG)) == stopped

    def test_a_servo_alone_on_its_bus_is_not_stopped_by_its_own_lost_answers(self):
        rig = make_rig(arm((11,)))
        once_armed(rig, 11, lambda one: [truncate_next(rig.buses[0], one, 0) for _ in range(3)])
        begin_ns = rig.clock.now_ns()
        rig.hardware.start()
        assert rig.clock.now_ns() - begin_ns > 10 * UNIT_NS, "its answers are awaited for longer"
        rig.cycles(100)
        assert armed(rig) == [10]
        assert rig.events.of(EventCode.WATCHDOG) == []

    def test_a_slow_adapter_stops_none(self):
        rig = make_rig(arm(range(11, 23)))
        for servo_id in range(11, 23):
            once_armed(rig, servo_id, lambda one: delay_next(rig.buses[0], one, 60 * MS))
        rig.hardware.start()
        assert armed(rig) == [10] * 12
        assert rig.events.of(EventCode.WATCHDOG) == []

    def test_none_is_taken_for_tripped_before_it_was_armed(self):
        """The first states are read once more after a pause that is longer than the watchdogs."""
        rig = make_rig(arm(ticks=2))
        read = rig.hardware.read_states

        def spoilt():
            truncate_next(rig.buses[0], 11, 4)
            rig.hardware.read_states = read
            read()

        rig.hardware.read_states = spoilt
        rig.hardware.start()
        assert rig.events.of(EventCode.READ_LOST)
        assert rig.events.of(EventCode.WATCHDOG) == []
        # goals are followed as fast as they say
        assert all(map(math.isnan, rig.hardware._servos[0].life.ceiling))


def test_a_process_that_stands_still_again_and_again_before_a_read_shows_no_older_states(started):
    """Each time behind what was done about the one before, and before the read."""
    started.cycles(5)
    prepare, left = started.hardware._prepare_read, [SECOND_NS] * 2

    def prepared():
        prepare()
        if left:
            started.wait(left.pop())

    started.hardware._prepare_read = prepared
    started.wait(SECOND_NS)
    started.hardware.read_states()
    assert not left
    assert started.states.valid.all()
    assert max(started.states.age_ns) < started.period_ns
    started.cycles(100)
    assert armed(started) == [10] * 4


class TestLeftHolding:
    """A robot that is left with its torque on: nothing is sent any more, so no watchdog may be armed."""

    def leave(self, rig):
        """Leave the torque on; return what was reported, and where the servos are a second later."""
        stood = [servo.shaft_angle for servo in rig.buses[0].servos]
        before = len(rig.events.of(EventCode.WATCHDOG))
        rig.hardware.leave_torque_on()
        rig.wait(SECOND_NS)
        assert all(rig.torque())
        moved = [abs(servo.shaft_angle - at) for servo, at in zip(rig.buses[0].servos, stood, strict=True)]
        return rig.events.texts(EventCode.WATCHDOG)[before:], moved

    def test_servos_that_were_stopped_stay_where_they_stopped(self, started):
        move_far(started)
        started.wait(300 * MS)
        told, moved = self.leave(started)
        assert max(moved) < 0.002
        assert armed(started) == [TRIPPED] * 4
        assert len(told) == 4
        assert "arm_12_joint (ID 12 on bus arm) was stopped by its Bus Watchdog (98)" in told[1]

    def test_one_that_was_stopped_among_others_stays_where_it_stopped(self, started):
        move_far(started)
        trip(started.servo(12))
        started.wait(100 * MS)
        _, moved = self.leave(started)
        assert armed(started) == [0, TRIPPED, 0, 0]
        assert moved[1] < 0.002

    def test_a_silent_one_stops_no_others(self):
        rig = start_rig(arm(range(11, 23)))
        rig.cycles(5)
        rig.servo(14).silence()
        (told,), _ = self.leave(rig)
        assert armed(rig) == [0, 0, 0, TRIPPED] + [0] * 8
        assert "arm_14_joint (ID 14 on bus arm) did not answer when its Bus Watchdog (98) was read" in told

    def test_many_are_disarmed_although_that_takes_longer_than_a_watchdog(self):
        rig = start_rig(arm(range(1, 25), ticks=2, return_delay_ns=500_000))
        rig.period_ns = 25 * MS
        rig.cycles(5)
        assert armed(rig) == [2] * 24
        assert self.leave(rig)[0] == []
        assert armed(rig) == [0] * 24


def test_a_servo_that_is_revived_goes_on_slowly_though_its_profile_was_reset(started):
    servo = started.servo(12)
    move_far(started)
    started.wait(300 * MS)
    assert (servo.registers["bus_watchdog"], servo.registers["profile_velocity"]) == (TRIPPED, 0)
    started.goals.velocity[:] = 10.0
    assert 0.5 < fastest(started, servo, 50) < 1.1 * RETURN_SPEED
    assert servo.registers["bus_watchdog"] == 10


@pytest.mark.parametrize("ratio", [1.0, 0.25, 3.0])
def test_shaft_of_a_lost_servo_returns_slowly_whatever_its_gear_though_its_profile_was_reset(ratio):
    rig = start_rig(arm(ratio=ratio, lower=-2.5 * ratio, upper=2.5 * ratio))
    servo = rig.servo(12)
    rig.goals.position[:], rig.goals.velocity[:] = 2.0 * ratio, 0.2 * ratio
    rig.cycles(5)
    servo.silence()
    rig.cycles(5)
    trip(servo)
    servo.silence(False)
    rig.goals.velocity[:] = 10.0 * ratio
    assert fastest(rig, servo, 100) == pytest.approx(RETURN_SPEED, rel=0.1)
    assert servo.registers["bus_watchdog"] == 10


def test_a_servo_that_its_watchdog_stopped_gets_no_goal_before_its_torque_was_read(started):
    started.restless = 0.002
    started.cycles(5)
    started.wait(300 * MS)
    count = len(started.into_bus())
    started.cycles(30)
    since = started.into_bus()[count:]
    for servo_id in (11, 12, 13, 14):
        asked = since.index(protocol2.read_range(servo_id, 64, 1))
        named = [at for at, p in enumerate(since) if p[7] == 0x83 and p[8] != 98 and servo_id in p[12:-2:9]]
        assert named
        assert named[0] > asked


def disarm(answer):
    """Disarm the watchdog of a servo that answers each packet; return what was written, and the problem."""
    plan, found = arm(), {}
    program = watchdog.disarm(access_servo(plan, plan.servos[0]))
    request = next(program)
    try:
        while True:
            packet = request.packet
            address = int.from_bytes(packet[8:10], "little")
            if packet[7] == 3:
                found[address] = packet[10:-2]
            request = program.send(answer(packet, address, found))
    except StopIteration as end:
        return found, end.value


def reply(data=b"", *, timeout=False):
    return Reply(TransactionOutcome.TIMEOUT if timeout else TransactionOutcome.OK, 0, data, 0, 0, False)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (reply(timeout=True), "did not answer when Bus Watchdog (98) was read back"),
        (reply(b"\x0a"), "has Bus Watchdog (98) = 10 after 0 was written"),
    ],
)
def test_a_watchdog_that_is_not_read_as_0_is_written_and_is_not_cleared(answer, said):
    written, problem = disarm(lambda *_: answer)
    assert written[98] == b"\0"
    assert said in problem


@pytest.mark.parametrize(
    ("silent", "written", "said"),
    [
        (None, {112, 98, 104}, ""),
        (11, {112}, "did not answer when its Operating Mode (11) was read"),
        (104, {112, 98, 104, 64}, "did not acknowledge Goal Velocity (104) = 0"),
    ],
)
def test_a_servo_that_follows_velocities_is_freed_of_its_watchdog_only_to_stand(silent, written, said):
    def answer(packet, address, found):
        data = b"" if packet[7] == 3 else b"\1\xff" if address == 11 else found.get(98, b"\xff")
        return reply(data, timeout=address == silent)

    found, problem = disarm(answer)
    assert said in problem
    assert bool(problem) == bool(said)
    assert found.keys() == written
    assert not any(any(data) for address, data in found.items() if address != 112)
