"""Hardware on one bus, however its servos are read, and on two, judged by the ledger and the servos."""

import math

import numpy as np
import pytest
from tests.kit.line_faults import corrupt_next, delay_next
from tests.kit.rigs import goals_in, make_plan, make_rig, make_x, position_tick, start_rig

from dxlrun.channels.event_records import EventCode
from dxlrun.dynamixel.servo.item_access import access_servo
from dxlrun.dynamixel.servo.torque_off import limp
from dxlrun.errors import StartUpError
from dxlsim.simulation_plan import ServoConfig
from dxlwire.wire import protocol1


def torque_read(plan, index):
    return next(access_servo(plan, plan.servos[index]).read_torque()).packet


def torque_given(rig, since=0):
    """Return what would switch torque on: goals, and torque enable = 1."""
    at = rig.plans[0].servos[0].torque_address
    enabled = [one for one in rig.writes(since) if one[1] == at and one[2] == b"\1"]
    return enabled + [named for address, named in rig.goals_sent(since) if address != at]


LATE_MS = [
    *(12.5, 14.0, 19.55, 19.65, 19.75, 19.8, 20.1, 20.2, 20.6, 20.7, 21.1, 21.2, 21.25, 21.3, 21.35, 21.4),
    *(21.45, 21.5, 21.55, 21.6, 21.65, 21.7, 21.75, 27.0, 33.3, 40.5, 41.0, 60.2),
]
"""Dense where a late reply meets the next one to the same servo."""


class OneBus:
    """What holds for every bus; a subclass has a plan of at least five servos."""

    plan = make_plan()

    @pytest.fixture
    def rig(self):
        return start_rig(self.plan)

    @property
    def ids(self):
        return [servo.servo_id for servo in self.plan.servos]

    def test_start_holds_every_servo_where_it_stands(self, rig):
        assert all(rig.torque())
        assert rig.states.valid.all()
        assert np.isnan(rig.goals.velocity).all()
        assert rig.goals.position == pytest.approx(rig.states.position, abs=0.006)
        before = [servo.shaft_angle for servo in rig.buses[0].servos]
        rig.cycles(10)
        assert [servo.shaft_angle for servo in rig.buses[0].servos] == pytest.approx(before, abs=0.006)
        assert len(rig.events.of(EventCode.SETUP)) == len(before)
        assert len(rig.events.of(EventCode.TORQUE_ON)) == 1
        assert rig.events.of(EventCode.REGISTER_DIFFERS) == []

    def test_nothing_gives_torque_without_start(self):
        rig = make_rig(self.plan)
        rig.goals.position[:] = 0.0
        rig.cycles(5)
        assert torque_given(rig) == []
        assert not any(rig.torque())

    def test_goals_move_the_servos_both_ways(self, rig):
        for goal in (0.3, -0.4):
            rig.goals.position[:] = goal
            rig.cycles(80)
            assert rig.states.position == pytest.approx(goal, abs=0.01)
        assert rig.events.of(EventCode.READ_LOST) == []

    def test_velocity_has_the_joints_sign(self, rig):
        rig.goals.position[:] = np.resize([1.8, -1.8], len(self.ids))
        rig.goals.velocity[:] = 1.0
        standing = rig.states.position.copy()
        rig.cycles(7)
        assert rig.states.velocity == pytest.approx(np.sign(rig.goals.position - standing), abs=0.3)

    def test_what_is_recorded_is_what_the_ledger_has(self, rig):
        rig.goals.position[:] = 0.2
        rig.buses[0].inject_noise(b"\x12\xff\xff\x03noise\xff", rig.clock.now_ns() + 100_000)
        corrupt_next(rig.buses[0], self.ids[2])
        rig.cycles(5)
        rig.hardware.stop()
        rig.hardware.idle(rig.clock.now_ns() + 10_000_000)
        assert rig.packets.sent() == rig.into_bus()
        assert rig.packets.received() == rig.out_of_bus()
        assert rig.events.of(EventCode.BUS_NOISE) != []

    def test_noise_that_is_not_reported_yet_is_reported_a_second_later(self, rig):
        for _ in range(2):
            rig.cycles(5)
            rig.buses[0].inject_noise(b"\x12\x13", rig.clock.now_ns() + 15_000_000)
        rig.cycles(20)
        assert len(rig.events.of(EventCode.BUS_NOISE)) == 1
        rig.cycles(60)
        assert len(rig.events.of(EventCode.BUS_NOISE)) == 2

    def test_a_silent_servo_is_invalid_and_ages_and_the_others_go_on(self, rig):
        rig.cycle()
        here = rig.states.position.copy()
        rig.servo(self.ids[2]).silence()
        rig.goals.position[:] += 0.2
        rig.cycles(10)
        assert rig.states.valid.tolist() == [row != 2 for row in range(len(self.ids))]
        assert rig.states.position[2] == here[2]
        assert rig.states.age_ns[2] > 9 * rig.period_ns
        assert (rig.states.age_ns[rig.states.valid] < rig.period_ns).all()
        assert (np.delete(rig.states.position - here, 2) > 0.1).all()
        assert self.plan.servos[2].joint in set(rig.events.sources(EventCode.READ_LOST))

    def test_a_silent_servo_gets_no_goal_until_its_torque_was_read(self, rig):
        rig.restless = 0.006
        servo = rig.servo(self.ids[2])
        servo.silence()
        before = len(rig.into_bus())
        rig.cycles(2)
        servo.silence(False)
        rig.cycles(6)
        sent, probe = rig.into_bus()[before:], torque_read(self.plan, 2)
        goals = [(at, named[1]) for at, p in enumerate(sent) if (named := goals_in(p, self.plan.protocol))]
        named = [at for at, ids in goals if self.ids[2] in ids]
        assert sent.count(probe) == 1
        assert goals[2][0] < sent.index(probe) < named[0]
        assert named[-1] == goals[-1][0]
        assert any("2 replies" in text for _, text in rig.events.of(EventCode.READ_BACK))

    def test_a_servo_that_was_reset_stays_out_and_gets_no_torque(self, rig):
        servo = rig.servo(self.ids[2])
        servo.silence()
        rig.cycle()
        servo.power_cycle()
        servo.silence(False)
        rig.cycles(20)
        assert rig.torque() == [row != 2 for row in range(len(self.ids))]
        assert rig.states.valid.all()
        ((source, text),) = rig.events.of(EventCode.SERVO_LIMP)
        assert source == self.plan.servos[2].joint
        assert f"Torque Enable ({self.plan.servos[2].torque_address})" in text

    def test_a_corrupted_reply_is_not_a_value(self, rig):
        rig.cycle()
        held = rig.states.position[1]
        corrupt_next(rig.buses[0], self.ids[1], index=5, flip=0x40)
        rig.cycle()
        assert not rig.states.valid[1]
        assert rig.states.position[1] == held
        assert "garbled" in rig.events.of(EventCode.READ_LOST)[0][1]
        rig.cycles(2)
        assert rig.states.valid.all()

    def test_nan_goals_are_not_sent(self, rig):
        rig.goals.position[3] = np.nan
        before = len(rig.into_bus())
        rig.goals.position[:3] += 0.1
        rig.goals.position[4:] += 0.1
        rig.cycle()
        ((_, named),) = rig.goals_sent(before)
        assert named == self.ids[:3] + self.ids[4:]

    def test_all_servos_silent_at_once_costs_less_than_the_guardian_waits(self, rig):
        rig.cycle()
        for servo in rig.buses[0].servos:
            servo.silence()
        for most_ms in (30, 20):
            start = rig.clock.now_ns()
            rig.hardware.read_states()
            assert rig.clock.now_ns() - start < most_ms * 1_000_000
        assert not rig.states.valid.any()

    def truth(self, rig, row):
        """Return where a joint stands, as the simulated servo itself knows, rad."""
        servo = self.plan.servos[row]
        rig.torque()  # lets it move until now
        return servo.direction * (rig.servo(servo.servo_id).shaft_angle - servo.reference)

    @pytest.mark.parametrize(("place", "late_ms"), [(4 * (at % 2), late) for at, late in enumerate(LATE_MS)])
    def test_a_late_reply_is_never_taken_as_current(self, rig, place, late_ms):
        rig.goals.position[:] = np.resize([1.8, -1.8], len(self.ids))
        rig.goals.velocity[:] = 1.0
        rig.cycles(10)  # from here on each joint turns by 0.02 rad a cycle
        delay_next(rig.buses[0], self.ids[place], int(late_ms * 1e6))
        missed = 0
        for _ in range(8):
            deadline = rig.clock.now_ns() + rig.period_ns
            rig.hardware.read_states()
            for row in np.flatnonzero(rig.states.valid):
                aged = 1.1 * rig.states.age_ns[row] * 1e-9  # rad that it turned since it answered
                assert rig.states.position[row] == pytest.approx(self.truth(rig, row), abs=aged + 0.005)
            missed += not rig.states.valid[place]
            rig.hardware.write_goals()
            rig.hardware.idle(deadline)
            rig.clock.wait_until(deadline)
        assert missed >= 1
        assert rig.packets.received() == rig.out_of_bus()

    def states_of_others(self, rig):
        """Return how many valid states all but the first get in a second of cycles without a gap."""
        end_ns, count = rig.clock.now_ns() + 1_000_000_000, 0
        while rig.clock.now_ns() < end_ns:
            rig.goals.position[:] += 1e-3 * math.sin(rig.clock.now_ns() * 1e-9)
            rig.hardware.read_states()
            count += int(rig.states.valid[1:].sum())
            rig.hardware.write_goals()
            # what the goals take on the wire, and a little for controllers
            deadline = rig.clock.now_ns() + self.plan.budget.goals_ns + 100_000
            rig.hardware.idle(deadline)
            rig.clock.wait_until(max(deadline, rig.clock.now_ns()))
        return count

    def test_a_dead_servo_costs_the_others_less_than_a_twentieth(self, rig):
        """The first one is the worst to lose: a chain ends there."""
        before = self.states_of_others(rig)
        rig.servo(self.ids[0]).silence()
        assert self.states_of_others(rig) > 0.95 * before

    def test_the_heart_beats_while_the_robot_is_set_up_and_read(self, rig):
        rig.cycle()
        assert np.diff(rig.beats).max() <= 21_000_000  # the pause between two groups
        assert rig.beats[-1] > rig.clock.now_ns() - 2 * rig.period_ns

    def test_stop_limps_every_servo_and_nothing_gives_torque_again(self, rig):
        rig.cycle()
        assert rig.hardware.stop() == ()
        assert not any(rig.torque())
        assert len(rig.events.of(EventCode.TORQUE_OFF)) == 1
        since = len(rig.into_bus())
        rig.cycle()
        assert torque_given(rig, since) == []

    def test_a_robot_whose_loop_died_becomes_limp(self, rig):
        recorded = len(rig.packets.sent())
        outcomes = limp(rig.lines)
        assert all(one.confirmed for one in outcomes)
        assert not any(rig.torque())
        assert rig.packets.sent()[recorded] == self.plan.limp[0].packet
        assert rig.packets.sent() == rig.into_bus()
        assert rig.packets.received() == rig.out_of_bus()

    def test_extra_servos_on_the_line_are_left_alone(self):
        servo = self.plan.servos[0]
        rig = start_rig(self.plan, extra=(ServoConfig(99, servo.model, 1.0),))
        rig.cycle()
        assert rig.torque() == [True] * len(self.ids) + [False]


class TestOneByOne(OneBus):
    plan = make_plan()


class TestBulkRead(OneBus):
    """MX of Protocol 1.0, beside AX on the same line."""

    plan = make_plan(
        (1, 2, 3, 4, 5), models=("AX-12A", "MX-64", "MX-28", "AX-12A", "MX-64"), lower=-2.0, upper=2.0
    )


class TestSyncRead(OneBus):
    plan = make_x()


class TestFastSyncRead(OneBus):
    plan = make_x(fast=True)


@pytest.fixture
def started():
    return start_rig()


def position_replies(rig, cycle_start):
    """Return raw position by ID, as the servos sent it since `cycle_start` (ledger)."""
    found = {}
    for entry in rig.ledger.entries:
        if entry.direction == "out" and entry.t_ns >= cycle_start and len(entry.data) == 12:
            found[entry.data[2]] = int.from_bytes(entry.data[5:7], "little")
    return found


def test_a_cycle_is_eight_reads_and_one_sync_write(started):
    count = len(started.into_bus())
    started.goals.position[:] = np.linspace(-0.5, 0.5, 8)
    started.goals.velocity[:] = 1.0
    start = started.clock.now_ns()
    started.cycle()
    expected = [read.packet for read in started.plans[0].reads]
    goals = {
        servo.servo_id: position_tick(servo, started.goals.position[servo.row]).to_bytes(2, "little")
        + b"\x56\x00"
        for servo in started.plans[0].servos
    }
    assert started.into_bus()[count:] == [*expected, protocol1.sync_write(30, 4, goals)]
    sent = position_replies(started, start)
    shown = [servo.joint_position(sent[servo.servo_id]) for servo in started.plans[0].servos]
    assert started.states.position == pytest.approx(shown, abs=1e-12)


def test_the_exchange_takes_what_the_budget_says():
    rig = start_rig()
    rig.cycle()
    start = rig.clock.now_ns()
    rig.hardware.read_states()
    budget = rig.plans[0].budget
    assert rig.clock.now_ns() - start == budget.total_ns - 480_000


def test_a_servo_whose_torque_fits_no_gap_gets_its_goals_back_all_the_same():
    rig = start_rig(make_plan((1, 2), latency_ns=19_000_000))
    rig.restless = 0.006
    rig.servo(2).silence()
    before = len(rig.into_bus())
    rig.cycle(idle=False)
    rig.servo(2).silence(False)
    rig.cycles(60)
    sent = rig.into_bus()[before:]
    named = [2 in packet[7:-1:5] for packet in sent if packet[4] == 0x83]
    assert not any(named[:40])
    assert all(named[-5:])
    assert sent.count(torque_read(rig.plans[0], 1)) == 1
    ((source, text),) = rig.events.of(EventCode.OVERRUN)
    assert source == "main_2_joint"
    assert "of idle time, but a cycle leaves only" in text


@pytest.mark.parametrize("step", [0.05, -0.05])
def test_a_servo_that_was_lost_goes_slowly_to_a_goal_that_went_on(started, step):
    started.restless = 0.006
    servo = started.servo(5)
    servo.silence()
    for _ in range(20):
        started.goals.position[2] += step  # each is small, and the servo sees none of them
        started.cycle()
    servo.silence(False)
    for _ in range(80):
        started.cycle()
        if started.states.valid[2]:
            break
    before = len(started.into_bus())
    standing = servo.shaft_angle
    started.cycles(20)
    writes = [packet for packet in started.into_bus()[before:] if packet[4] == 0x83]
    speeds = [dict(zip(p[7:-1:5], p[10:-1:5], strict=True)) for p in writes]  # all fit the low byte
    assert {one[5] for one in speeds if 5 in one} == {129}  # 1.5 rad/s, and never 0, which is the maximum
    assert {one[3] for one in speeds} == {0}
    assert 0.3 < abs(servo.shaft_angle - standing) < 1.5 * 20 * 0.02
    started.cycles(40)
    last = [packet for packet in started.into_bus() if packet[4] == 0x83][-1]
    assert dict(zip(last[7:-1:5], last[10:-1:5], strict=True))[5] == 0
    assert started.states.position[2] == pytest.approx(started.goals.position[2], abs=0.01)


def test_a_changed_error_byte_is_told_in_the_manuals_words(started):
    started.cycle()
    started.servo(6).set_temperature(85.0)
    started.cycle()
    started.cycle()
    (event,) = started.events.of(EventCode.SERVO_ERROR)
    assert event[0] == "main_6_joint"
    assert "overheating" in event[1]
    assert "ID 6 on bus main" in event[1]
    assert started.states.valid[3]


@pytest.mark.parametrize(("error", "shown"), [(0x02, 0), (0x08, 0), (0x04, 0x04), (0x06, 0x04), (0x20, 0x20)])
def test_the_states_have_only_the_hardware_errors_of_an_error_byte(started, error, shown):
    def report(reply):
        return protocol1.status_packet(6, error, reply[5:-1])

    started.cycle()
    started.buses[0].alter_next(6, "an error", report)
    started.cycle()
    assert started.states.hardware_error[3] == shown
    assert len(started.events.of(EventCode.SERVO_ERROR)) == 1


def test_a_servo_that_is_reset_while_the_others_get_torque_ends_the_start():
    """It answers again before the first cycle, so no reply is missing; its next goal would be torque on."""
    rig = make_rig()
    reset = []

    def brown_out():
        if not reset and sum(rig.torque()) == 4:
            reset.append(1)
            rig.servo(1).power_cycle()

    for step in range(4000):
        rig.buses[0].at(rig.clock.now_ns() + step * 100_000, brown_out)
    with pytest.raises(StartUpError, match=r"main_1_joint \(ID 1 on bus main\) lost its torque while"):
        rig.hardware.start()
    assert reset == [1]
    assert rig.torque() == [False] * 8
    assert [packet for packet in rig.into_bus() if packet[4] == 0x83] == []


def test_a_line_that_goes_between_read_and_write_is_named_and_the_others_get_their_goals():
    rig = start_rig(make_plan((1, 2), name="left"), make_plan((1, 7), name="right", first_row=2))
    rig.hardware.read_states()
    rig.ports.ports[0].unplug()
    rig.hardware.write_goals()
    ((source, text),) = rig.events.of(EventCode.PORT_LOST)
    assert source == "left"
    assert text.startswith("bus left on sim: ")
    assert rig.into_bus(1)[-1][4] == 0x83


@pytest.mark.parametrize(("back_after_ns", "limp"), [(150_000_000, True), (400_000_000, False)])
def test_an_adapter_that_is_back_soon_after_the_end_finds_torque_off_sent(back_after_ns, limp):
    rig = start_rig(make_plan((1, 2), name="left"), make_plan((1, 7), name="right", first_row=2))
    rig.cycle()
    bus = rig.buses[0]
    bus.unplug()
    bus.at(rig.clock.now_ns() + back_after_ns, bus.plug_in)
    before = rig.clock.now_ns()
    failures = rig.hardware.stop()
    assert rig.torque(1) == [False, False]  # nothing waited for the line that was gone
    assert rig.torque(0) == [not limp] * 2
    assert bool(failures) == (not limp)
    assert rig.clock.now_ns() - before < 500_000_000


@pytest.mark.parametrize("right", [make_plan((1, 7), name="right", first_row=2), make_x((1, 7), first_row=2)])
def test_two_buses_are_read_side_by_side(right):
    rig = start_rig(make_plan((1, 2), name="left"), right)
    rig.goals.position[:] = [0.1, 0.2, 0.3, -0.4]
    start = rig.clock.now_ns()
    rig.hardware.read_states()
    assert rig.clock.now_ns() - start == 2 * 700_000
    rig.cycles(80)
    assert rig.states.position == pytest.approx([0.1, 0.2, 0.3, -0.4], abs=0.01)
    rig.servo(2).silence()
    rig.cycle()
    assert rig.states.valid.tolist() == [True, False, True, True]
    assert rig.hardware.stop() != ()
    assert rig.torque(1) == [False, False]
    for bus in (0, 1):
        assert rig.packets.sent(bus) == rig.into_bus(bus)
        assert rig.packets.received(bus) == rig.out_of_bus(bus)
