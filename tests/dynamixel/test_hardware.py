"""Hardware on one bus, however its servos are read, on two, and beside another host."""

import math
from functools import partial

import numpy as np
import pytest
from tests.kit.line_faults import corrupt_next, delay_next, other_host, truncate_next
from tests.kit.rigs import X_IDS, goals_in, make_plan, make_rig, make_x, start_rig

from dxlrun.channels.event_records import EventCode, Severity
from dxlrun.dynamixel.servo.item_access import access_servo
from dxlrun.dynamixel.servo.servo_supervision import UNREQUESTED_EVENT_NS
from dxlrun.dynamixel.servo.torque_off import limp
from dxlwire.exchange.bus_engine import BEAT_NS
from dxlwire.packets import PacketKind
from dxlwire.wire import protocol1, protocol2

MS = 1_000_000
MX = make_plan((1, 2, 3, 4, 5), models=("AX-12A", "MX-64", "MX-28", "AX-12A", "MX-64"), lower=-2.0, upper=2.0)
PLANS = {
    "one by one": make_plan(),
    "bulk read": MX,
    "sync read": make_x(),
    "fast sync read": make_x(fast=True),
}
LATE_MS = [
    *(12.5, 14.0, 19.55, 19.65, 19.75, 19.8, 20.1, 20.2, 20.6, 20.7, 21.1, 21.2, 21.25, 21.3, 21.35, 21.4),
    *(21.45, 21.5, 21.55, 21.6, 21.65, 21.7, 21.75, 27.0, 33.3, 40.5, 41.0, 60.2),
]
"""Dense where a late reply meets the next one to the same servo."""


def torque_read(plan, index):
    return next(access_servo(plan, plan.servos[index]).read_torque()).packet


def torque_given(rig, since=0):
    """Return what would switch torque on: goals, and torque enable = 1."""
    at = rig.plans[0].servos[0].torque_address
    enabled = [one for one in rig.writes(since) if one[1] == at and one[2] == b"\1"]
    return enabled + [named for address, named in rig.goals_sent(since) if address != at]


@pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
class TestOneBus:
    """What holds for every bus, in whichever way its servos are read."""

    @pytest.fixture
    def rig(self, plan):
        return start_rig(plan)

    @pytest.fixture
    def ids(self, plan):
        return [servo.servo_id for servo in plan.servos]

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

    def test_nothing_gives_torque_without_start(self, plan):
        rig = make_rig(plan)
        rig.goals.position[:] = 0.0
        rig.cycles(5)
        assert torque_given(rig) == []
        assert not any(rig.torque())

    def test_goals_move_the_servos_both_ways_with_the_joints_sign(self, rig):
        for goal in (0.3, -0.4):
            rig.goals.position[:] = goal
            rig.cycles(80)
            assert rig.states.position == pytest.approx(goal, abs=0.01)
        assert rig.events.of(EventCode.READ_LOST) == []
        rig.goals.position[:] = np.resize([1.8, -1.8], len(rig.states.valid))
        rig.goals.velocity[:] = 1.0
        rig.cycles(7)
        assert rig.states.velocity == pytest.approx(np.sign(rig.goals.position), abs=0.3)

    def test_what_is_recorded_is_what_the_ledger_has(self, rig, ids):
        rig.goals.position[:] = 0.2
        rig.buses[0].inject_noise(b"\x12\xff\xff\x03noise\xff", rig.clock.now_ns() + 100_000)
        corrupt_next(rig.buses[0], ids[2])
        rig.cycles(5)
        rig.hardware.stop()
        rig.hardware.idle(rig.clock.now_ns() + 10 * MS)
        assert rig.packets.sent() == rig.into_bus()
        assert rig.packets.received() == rig.out_of_bus()
        assert rig.events.of(EventCode.BUS_NOISE) != []

    def test_noise_that_is_not_reported_yet_is_reported_a_second_later(self, rig):
        for _ in range(2):
            rig.cycles(5)
            rig.buses[0].inject_noise(b"\x12\x13", rig.clock.now_ns() + 15 * MS)
        rig.cycles(20)
        assert len(rig.events.of(EventCode.BUS_NOISE)) == 1
        rig.cycles(60)
        assert len(rig.events.of(EventCode.BUS_NOISE)) == 2

    def test_a_silent_servo_is_invalid_and_ages_and_the_others_go_on(self, rig, plan, ids):
        rig.cycle()
        here = rig.states.position.copy()
        rig.servo(ids[2]).silence()
        rig.goals.position[:] += 0.2
        rig.cycles(10)
        assert rig.states.valid.tolist() == [row != 2 for row in range(len(ids))]
        assert rig.states.position[2] == here[2]
        assert rig.states.age_ns[2] > 9 * rig.period_ns
        assert (rig.states.age_ns[rig.states.valid] < rig.period_ns).all()
        assert (np.delete(rig.states.position - here, 2) > 0.1).all()
        assert plan.servos[2].joint in set(rig.events.sources(EventCode.READ_LOST))

    def test_a_silent_servo_gets_no_goal_until_its_torque_was_read(self, rig, plan, ids):
        rig.restless = 0.006
        servo = rig.servo(ids[2])
        servo.silence()
        before = len(rig.into_bus())
        rig.cycles(2)
        servo.silence(False)
        rig.cycles(6)
        sent, probe = rig.into_bus()[before:], torque_read(plan, 2)
        goals = [(at, named[1]) for at, p in enumerate(sent) if (named := goals_in(p, plan.protocol))]
        named = [at for at, named in goals if ids[2] in named]
        assert sent.count(probe) == 1
        assert goals[2][0] < sent.index(probe) < named[0]
        assert named[-1] == goals[-1][0]
        assert any("2 replies" in text for text in rig.events.texts(EventCode.READ_BACK))

    def test_all_servos_silent_at_once_costs_less_than_the_guardian_waits(self, rig):
        rig.cycle()
        for servo in rig.buses[0].servos:
            servo.silence()
        for most_ms in (30, 20):
            assert read_takes(rig) < most_ms * MS
        assert not rig.states.valid.any()

    @pytest.mark.parametrize("place", [0, 4])
    def test_a_late_reply_is_never_taken_as_current(self, rig, plan, place):
        goals = np.resize([1.8, -1.8], len(plan.servos))
        rig.goals.velocity[:] = 1.0
        for late_ms in LATE_MS[place // 4 :: 2]:
            goals *= -1
            rig.goals.position[:] = goals
            rig.cycles(10)  # from here on each joint turns by 0.02 rad a cycle
            assert rig.states.valid.all()
            delay_next(rig.buses[0], plan.servos[place].servo_id, int(late_ms * 1e6))
            missed = 0
            for _ in range(8):
                deadline = rig.clock.now_ns() + rig.period_ns
                rig.hardware.read_states()
                rig.torque()  # lets the servos move until now
                for row in np.flatnonzero(rig.states.valid):
                    servo = plan.servos[row]
                    truth = servo.direction * (rig.servo(servo.servo_id).shaft_angle - servo.reference)
                    aged = 1.1 * rig.states.age_ns[row] * 1e-9  # rad that it turned since it answered
                    late = f"{late_ms} ms late"
                    assert rig.states.position[row] == pytest.approx(truth, abs=aged + 0.005), late
                missed += not rig.states.valid[place]
                rig.hardware.write_goals()
                rig.hardware.idle(deadline)
                rig.clock.wait_until(deadline)
            assert missed >= 1, f"{late_ms} ms late"
        assert rig.packets.received() == rig.out_of_bus()

    def test_a_dead_servo_costs_the_others_less_than_a_twentieth(self, rig, plan, ids):
        """The first one is the worst to lose: a chain ends there."""

        def states_of_others():
            """Return how many valid states all but the first get in half a second of cycles without a gap."""
            end_ns, count = rig.clock.now_ns() + 500 * MS, 0
            while rig.clock.now_ns() < end_ns:
                rig.goals.position[:] += 1e-3 * math.sin(rig.clock.now_ns() * 1e-9)
                rig.hardware.read_states()
                count += int(rig.states.valid[1:].sum())
                rig.hardware.write_goals()
                # what the goals take on the wire, and a little for controllers
                deadline = rig.clock.now_ns() + plan.budget.goals_ns + 100_000
                rig.hardware.idle(deadline)
                rig.clock.wait_until(max(deadline, rig.clock.now_ns()))
            return count

        before = states_of_others()
        rig.servo(ids[0]).silence()
        states_of_others()  # in which it is found to be lost
        assert states_of_others() > 0.95 * before

    def test_the_heart_beats_while_the_robot_is_set_up_and_read(self, rig):
        rig.cycle()
        assert np.diff(rig.beats).max() <= 20 * MS + BEAT_NS  # the pause between two groups, and a wait
        assert rig.beats[-1] > rig.clock.now_ns() - 2 * rig.period_ns

    def test_stop_limps_every_servo_and_nothing_gives_torque_again(self, rig):
        rig.cycle()
        assert rig.hardware.stop() == ()
        assert not any(rig.torque())
        assert len(rig.events.of(EventCode.TORQUE_OFF)) == 1
        since = len(rig.into_bus())
        rig.cycle()
        assert torque_given(rig, since) == []

    def test_a_robot_whose_loop_died_becomes_limp(self, rig, plan):
        recorded = len(rig.packets.sent())
        assert all(one.confirmed for one in limp(rig.lines))
        assert not any(rig.torque())
        assert rig.packets.sent()[recorded] == plan.limp[0].packet
        assert rig.packets.sent() == rig.into_bus()
        assert rig.packets.received() == rig.out_of_bus()


def read_takes(rig):
    """Return the time of one exchange, ns."""
    start = rig.clock.now_ns()
    rig.hardware.read_states()
    return rig.clock.now_ns() - start


@pytest.fixture
def ax():
    return start_rig()


@pytest.fixture
def arm():
    return start_rig(make_x())


def test_a_cycle_is_eight_reads_and_one_sync_write(ax):
    count, start = len(ax.into_bus()), ax.clock.now_ns()
    ax.goals.position[:] = np.linspace(-0.5, 0.5, 8)
    ax.goals.velocity[:] = 1.0
    ax.cycle()
    servos = ax.plans[0].servos
    angles = [servo.direction * ax.goals.position[servo.row] + servo.reference for servo in servos]
    ticks = [round(angle / servo.rad_per_tick) for servo, angle in zip(servos, angles, strict=True)]
    goals = {
        servo.servo_id: tick.to_bytes(2, "little") + b"\x56\x00"
        for servo, tick in zip(servos, ticks, strict=True)
    }
    reads = [read.packet for read in ax.plans[0].reads]
    assert ax.into_bus()[count:] == [*reads, protocol1.sync_write(30, 4, goals)]
    sent = {
        entry.data[2]: int.from_bytes(entry.data[5:7], "little")
        for entry in ax.ledger.entries
        if entry.direction == "out" and entry.t_ns >= start and len(entry.data) == 12
    }
    shown = [servo.joint_position(sent[servo.servo_id]) for servo in servos]
    assert ax.states.position == pytest.approx(shown, abs=1e-12)


def test_the_exchange_takes_what_protocol_md_and_the_budget_say(ax, arm):
    assert read_takes(arm) == 220_000 + 8 * 210_000
    ax.cycle()
    assert read_takes(ax) == ax.plans[0].budget.total_ns - 480_000


def test_a_servo_whose_torque_fits_no_gap_gets_its_goals_back_all_the_same():
    rig = start_rig(make_plan((1, 2), latency_ns=19 * MS))
    rig.restless = 0.006
    rig.servo(2).silence()
    before = len(rig.into_bus())
    rig.cycle(idle=False)
    rig.servo(2).silence(False)
    rig.cycles(60)
    named = [2 in ids for _, ids in rig.goals_sent(before)]
    assert not any(named[:40])
    assert all(named[-5:])
    assert rig.into_bus()[before:].count(torque_read(rig.plans[0], 1)) == 1
    ((source, text),) = rig.events.of(EventCode.OVERRUN)
    assert source == "main_2_joint"
    assert "of idle time, but a cycle leaves only" in text


@pytest.mark.parametrize("step", [0.05, -0.05])
def test_a_servo_that_was_lost_goes_slowly_to_a_goal_that_went_on(ax, step):
    ax.restless = 0.006
    servo = ax.servo(5)
    servo.silence()
    for _ in range(20):
        ax.goals.position[2] += step  # each is small, and the servo sees none of them
        ax.cycle()
    servo.silence(False)
    ax.until_valid()
    before, standing = len(ax.into_bus()), servo.shaft_angle
    ax.cycles(20)
    writes = [packet for packet in ax.into_bus()[before:] if packet[4] == 0x83]
    speeds = [dict(zip(p[7:-1:5], p[10:-1:5], strict=True)) for p in writes]  # all fit the low byte
    assert {one[5] for one in speeds if 5 in one} == {129}  # 1.5 rad/s, and never 0, which is the maximum
    assert {one[3] for one in speeds} == {0}
    assert 0.3 < abs(servo.shaft_angle - standing) < 1.5 * 20 * 0.02
    ax.cycles(40)
    last = [packet for packet in ax.into_bus() if packet[4] == 0x83][-1]
    assert dict(zip(last[7:-1:5], last[10:-1:5], strict=True))[5] == 0
    assert ax.states.position[2] == pytest.approx(ax.goals.position[2], abs=0.01)


@pytest.mark.parametrize(("error", "shown"), [(0x02, 0), (0x08, 0), (0x04, 0x04), (0x06, 0x04), (0x20, 0x20)])
def test_the_states_have_only_the_hardware_errors_of_an_error_byte(ax, error, shown):
    ax.cycle()
    ax.buses[0].alter_next(6, "an error", lambda reply: protocol1.status_packet(6, error, reply[5:-1]))
    ax.cycle()
    assert ax.states.hardware_error[3] == shown
    assert ax.states.valid[3]
    assert len(ax.events.of(EventCode.SERVO_ERROR)) == 1


@pytest.mark.parametrize("late_ms", [20.1, 20.3, 20.6, 20.9, 40.3, 40.6])
def test_late_replies_of_three_silent_servos_are_never_taken_as_current(late_ms):
    """Three losses of one group in one cycle: the next request must still differ from the one before."""
    rig = start_rig(make_x((11, 12, 13)))
    servos = rig.buses[0].servos

    def silence(on):
        for servo in servos:
            servo.silence(on)

    silence(True)
    rig.cycle()
    silence(False)
    for servo in servos:
        delay_next(rig.buses[0], servo.servo_id, int(late_ms * 1e6))
    rig.cycle()
    silence(True)
    sent = len(rig.out_of_bus())
    for _ in range(2):  # no servo answers what is asked now: what arrives is old
        rig.cycle()
        assert not rig.states.valid.any()
    assert len(rig.out_of_bus()) > sent or late_ms > 40  # by then they are lost, and none is asked
    silence(False)
    rig.cycles(20)
    assert rig.states.valid.all()
    assert rig.packets.received() == rig.out_of_bus()


def test_servos_of_several_layouts_share_a_bus():
    models = ["XM430-W350", "XL-320", "XM430-W350", "XL-320"]
    middle = {"reference": math.radians(150), "lower": -2.0, "upper": 2.0}
    rig = start_rig(make_plan((1, 2, 3, 4), protocol=2.0, models=models, **middle))
    assert rig.plans[0].groups == ((0, 2), (1, 3))
    rig.goals.position[:] = [0.3, -0.3, 0.2, -0.2]
    rig.cycles(80)
    errors = np.abs(rig.states.position - [0.3, -0.3, 0.2, -0.2])
    assert (errors < [0.01, 0.07, 0.01, 0.07]).all()  # an XL-320 may rest as far from its goal as 3.3 degrees
    assert rig.events.of(EventCode.READ_LOST) == []
    assert rig.hardware.stop() == ()
    assert rig.torque() == [False] * 4
    # no servo was told to write at the address where the other model has its torque enable
    assert [packet for packet in rig.into_bus() if packet[4] == 254 and packet[7] == 3] == []


# Two buses


@pytest.fixture
def two():
    return start_rig(make_plan((1, 2), name="left"), make_plan((1, 7), name="right", first_row=2))


def test_a_line_that_goes_between_read_and_write_is_named_and_the_others_get_their_goals(two):
    two.hardware.read_states()
    two.ports.ports[0].unplug()
    two.hardware.write_goals()
    ((source, text),) = two.events.of(EventCode.PORT_LOST)
    assert source == "left"
    assert text.startswith("bus left on sim: ")
    assert two.into_bus(1)[-1][4] == 0x83


@pytest.mark.parametrize(("back_after_ms", "limp"), [(150, True), (400, False)])
def test_an_adapter_that_is_back_soon_after_the_end_finds_torque_off_sent(two, back_after_ms, limp):
    two.cycle()
    bus = two.buses[0]
    bus.unplug()
    bus.at(two.clock.now_ns() + back_after_ms * MS, bus.plug_in)
    before = two.clock.now_ns()
    failures = two.hardware.stop()
    assert two.torque(1) == [False, False]  # nothing waited for the line that was gone
    assert two.torque(0) == [not limp] * 2
    assert bool(failures) == (not limp)
    assert two.clock.now_ns() - before < 500 * MS


@pytest.mark.parametrize("right", [partial(make_plan, name="right"), make_x], ids=["AX", "X"])
def test_two_buses_are_read_side_by_side(right):
    rig = start_rig(make_plan((1, 2), name="left"), right((1, 7), first_row=2))
    rig.goals.position[:] = [0.1, 0.2, 0.3, -0.4]
    assert read_takes(rig) == 2 * 700_000
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


def test_the_heart_beats_while_a_lost_line_is_awaited_at_the_end():
    rig = start_rig(make_x((11, 12)))
    rig.buses[0].unplug()
    rig.hardware.stop()
    assert np.diff([*rig.beats, rig.clock.now_ns()]).max() <= 21 * MS


FAST_SYNC_READ = protocol2.Protocol2Instruction.FAST_SYNC_READ
SYNC_READ = protocol2.Protocol2Instruction.SYNC_READ


@pytest.fixture
def fast():
    return start_rig(make_x(fast=True))


@pytest.fixture
def mixed():
    """MX servos with old firmware, which know a bulk read, beside AX on the same line."""
    return start_rig(MX)


def passed(rig, since, direction):
    """Return the packets that passed the line behind so many entries of the ledger."""
    return [entry.data for entry in rig.ledger.entries[since:] if entry.direction == direction]


def test_a_cycle_is_one_fast_sync_read_with_one_status_as_in_the_budget(fast):
    since, start = len(fast.ledger.entries), fast.clock.now_ns()
    fast.hardware.read_states()
    took_ns = fast.clock.now_ns() - start
    assert passed(fast, since, "in") == [protocol2.sync_read(126, 10, X_IDS, fast=True)]
    assert len(b"".join(passed(fast, since, "out"))) == 8 + 8 * 14
    assert took_ns == (22 + 120) * 10_000
    assert fast.states.valid.all()
    fast.hardware.write_goals()
    budget = fast.plans[0].budget
    since = len(fast.ledger.entries)
    fast.cycle()
    assert sum(map(len, passed(fast, since, "in"))) == budget.request_bytes
    assert sum(map(len, passed(fast, since, "out"))) == budget.reply_bytes


@pytest.mark.parametrize(
    ("absent", "fast_form", "first", "then"),
    [
        (14, True, "11100000", "11101111"),
        (14, False, "11100000", "11101111"),
        (3, None, "11010", "11011"),
    ],
    ids=["fast", "sync", "bulk"],
)
def test_who_comes_before_an_absent_servo_keeps_its_sample(mixed, absent, fast_form, first, then):
    rig = mixed if fast_form is None else start_rig(make_x(fast=fast_form))
    rig.cycle()
    rig.servo(absent).silence()
    rig.cycle()
    assert rig.states.valid.tolist() == [one == "1" for one in first]
    for _ in range(3):
        rig.cycle()
        assert rig.states.valid.tolist() == [one == "1" for one in then]
    rig.servo(absent).silence(False)
    rig.cycles(20)  # it was lost, and is looked at as at the start
    assert rig.states.valid.all()
    assert rig.packets.received() == rig.out_of_bus()


def test_a_spoilt_byte_costs_that_servo_and_those_behind_it(fast):
    fast.cycle()
    corrupt_next(fast.buses[0], 14)
    before = len(fast.packets.list)
    fast.cycle()
    assert fast.states.valid.tolist() == [True] * 3 + [False] * 5
    # the log has the three as replies, and says of the first bad one alone that it was garbled
    (status,) = [one for one in fast.packets.list[before:] if one.kind is PacketKind.STATUS]
    assert (status.servo_id, len(status.data)) == (0xFE, 8 + 3 * 14)
    assert [one.servo_id for one in protocol2.fast_answers(status.data, [10] * 8)] == [11, 12, 13]
    lost = fast.events.of(EventCode.READ_LOST)
    assert [text.rpartition(": ")[2].endswith("garbled reply") for _, text in lost] == [True] + [False] * 4
    assert fast.packets.received() == fast.out_of_bus()
    fast.cycles(2)
    assert fast.states.valid.all()


def test_servos_of_old_firmware_are_read_plainly_and_it_is_reported():
    rig = make_rig(make_x(fast=True))
    for servo_id in (13, 17):
        rig.servo(servo_id).poke("firmware_version", 44)
    rig.hardware.start()
    since = len(rig.ledger.entries)
    rig.cycle()
    assert rig.ledger.entries[since].data == protocol2.sync_read(126, 10, X_IDS)
    assert rig.states.valid.all()
    (text,) = [text for _, severity, _, text in rig.events.list if severity is Severity.WARNING]
    assert "they need firmware 45" in text
    assert "arm_13_joint (ID 13 on bus arm) has 44" in text
    assert "arm_17_joint (ID 17 on bus arm) has 44" in text
    assert "2.76 ms instead of 2.28 ms (at most 362 Hz)" in text


def test_replies_are_due_by_the_return_delays_that_the_servos_have():
    rig = make_rig(plan := make_plan((1, 2), return_delay_ns=100_000))
    rig.servo(2).poke("return_delay_time", 250)
    rig.hardware.start()
    (reads,) = [servos.reads for servos in rig.hardware._servos]
    assert plan.reads[0].due_ns == 300_000
    assert [request.patient[0].due_ns for request in reads.plan().queue] == [300_000, 700_000]


@pytest.mark.parametrize(
    ("protocol", "models", "latency_ns", "read_by"),
    [
        (1.0, ["AX-12A"] * 3, 0, "read"),
        (1.0, ["AX-12A", "MX-64"], 0, "read"),  # one MX alone
        (1.0, ["MX-28", "MX-64", "AX-12A"], 0, "bulk read + read"),
        (2.0, ["2XL430-W250"] * 3, 0, "sync read"),
        (2.0, ["XM430-W350"], 0, "read"),
        (2.0, ["XM430-W350"] * 8, 0, "fast sync read"),
        (2.0, ["XM430-W350"] * 4 + ["2XL430-W250"] * 2, 0, "fast sync read + sync read"),
        (2.0, ["XM430-W350"] * 3 + ["PM42-010-S260"] * 3, 0, "fast bulk read"),
        (2.0, ["2XL430-W250"] * 8 + ["XL-320"], 0, "sync read + read"),
        (2.0, ["2XL430-W250"] * 8 + ["XL-320"], 1_000_000, "bulk read"),
    ],
)
def test_the_cheapest_way_to_read_is_taken(protocol, models, latency_ns, read_by):
    ids, limits = range(1, len(models) + 1), {"lower": -0.1, "upper": 0.1}
    plan = make_plan(ids, protocol=protocol, models=models, latency_ns=latency_ns, fast=True, **limits)
    assert plan.read_by == read_by


def test_a_servo_that_forgets_the_fast_form_makes_its_group_be_read_plainly(fast):
    fast.servo(15).poke("firmware_version", 44)  # as after another one took its place
    fast.cycles(20)
    ((_, _, source, text),) = [e for e in fast.events.list if "fast reads in a row" in e[3]]
    assert source == "arm"
    assert "arm_15_joint" in text
    since = len(fast.ledger.entries)
    for _ in range(5):
        fast.cycle()
        assert fast.states.valid.all()
    asked = [data[7] for data in passed(fast, since, "in")]
    assert (asked.count(SYNC_READ), asked.count(FAST_SYNC_READ)) == (5, 0)


def test_a_servo_that_is_silent_now_and_then_leaves_its_group_the_fast_form(fast):
    for _ in range(8):
        fast.servo(15).silence()
        fast.cycle()
        fast.servo(15).silence(False)
        fast.cycles(3)
    since = len(fast.ledger.entries)
    fast.cycle()
    assert fast.ledger.entries[since].data[7] == FAST_SYNC_READ
    assert [e for e in fast.events.list if "fast reads in a row" in e[3]] == []


def test_mx_are_read_together_and_ax_one_by_one_with_a_latency_for_each_request(mixed):
    count = len(mixed.into_bus())
    mixed.cycle()
    *reads, goals = mixed.into_bus()[count:]
    assert reads == [
        protocol1.read_range(1, 36, 6),
        protocol1.bulk_read([(2, 36, 6), (3, 36, 6), (5, 36, 6)]),
        protocol1.read_range(4, 36, 6),
    ]
    assert goals[4:7] == bytes((0x83, 30, 4))
    assert mixed.states.valid.all()
    models = [servo.model for servo in MX.servos]
    budget = make_plan((1, 2, 3, 4, 5), models=models, latency_ns=1_000_000).budget
    assert (budget.latency_ns, budget.reply_bytes) == (3_000_000, 5 * 12)
    assert budget.request_bytes == 2 * 8 + (7 + 3 * 3) + (8 + 5 * 5)


IDLE_NS = 15_000_000
"""From the beginning of a cycle to when its exchange is over, and the next one has not begun."""
SHARED_IDS = (1, 2, 3, 4)
SHARED_PLANS = {
    "plain": make_plan(SHARED_IDS),
    "bulk": make_plan(SHARED_IDS, model="MX-28"),
    "sync": make_x(SHARED_IDS, name="main", return_delay_ns=500_000),
    "fast": make_x(SHARED_IDS, name="main", return_delay_ns=500_000, fast=True),
}
every_way = pytest.mark.parametrize("shared", SHARED_PLANS, indirect=True)
plain_way = pytest.mark.parametrize("shared", ["plain"], indirect=True)


class Shared:
    """Four servos that are read in a way, and another host on their line."""

    def __init__(self, way):
        self.rig = start_rig(SHARED_PLANS[way])
        self.rig.cycle()
        self.dialect = protocol1 if SHARED_PLANS[way].protocol == 1.0 else protocol2
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


@every_way
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


@every_way
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


@plain_way
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


@every_way
@pytest.mark.parametrize("fault", FAULTS)
def test_late_doubled_and_broken_replies_are_not_taken_for_those_to_another_host(shared, fault):
    for number in range(80):
        if number % 4 == 0:
            FAULTS[fault](shared.bus, 1 + number // 4 % 4)
        shared.rig.cycle()
    assert shared.rig.events.of(EventCode.READ_LOST) or fault in ("double", "noise")
    assert shared.told == []


@every_way
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
