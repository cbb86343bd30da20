"""Idle time, samples and reports of one bus."""

import numpy as np
import pytest
from tests.kit.kept_events import Events
from tests.kit.rigs import make_plan, make_rig, make_x

from dxlrun.channels.event_records import EventCode
from dxlrun.dynamixel.wire_reports import WireReports
from dxlwire.exchange.idle import STARVED, STARVED_AGAIN, IdleScheduler, Urgency
from dxlwire.exchange.reports import Reason
from dxlwire.exchange.samples import REPORT_AGAIN_NS
from dxlwire.plan.line import listen_transaction
from dxlwire.plan.planning import plan_line
from dxlwire.transaction import TransactionOutcome
from dxlwire.wire import protocol2

READ_NS = 270_000
"""14 bytes there, 13 back, 1 Mbit/s, no return delay: what one of the reads below takes."""


class Rounds:
    """One bus whose idle times come one after the other, each a millisecond after the one before."""

    def __init__(self):
        self.rig = make_rig(make_x((11, 12)))
        self.lines = self.rig.lines
        (self.bus,) = self.lines.buses
        self.idle = IdleScheduler(self.bus, WireReports(self.rig.events))

    def gap(self, length_ns):
        until = self.rig.clock.now_ns() + length_ns
        count = len(self.rig.into_bus())
        if self.idle.begin_idle(until):
            self.bus.load_job(self.idle)
            self.lines.pump()
        self.over_ns = self.rig.clock.now_ns() - until
        self.rig.clock.wait_until(until + 1_000_000)
        return self.rig.into_bus()[count:]

    def add(self, program, done, *others, **more):
        def ended():
            done((yield from program))

        self.idle.add(ended(), *others, **more)

    def read(self, servo_id, address, size=1):
        return plan_line(self.rig.plans[0]).read_range(servo_id, address, size)


@pytest.fixture
def rounds():
    return Rounds()


def reading(rounds, servo_id, *addresses):
    found = []
    for address in addresses:
        reply = yield rounds.read(servo_id, address)
        found.append(reply.parameters[0] if reply.answered else reply.outcome)
    return found


def test_a_program_goes_on_from_gap_to_gap(rounds):
    found = []
    rounds.add(reading(rounds, 11, 7, 11, 64), found.append, Urgency.SLOW, "three reads")
    sent = [rounds.gap(READ_NS + 150_000) for _ in range(4)]
    assert sent == [[protocol2.read_range(11, address, 1)] for address in (7, 11, 64)] + [[]]
    assert found == [[11, 3, 0]]
    assert rounds.idle.waiting == 0


def test_the_more_urgent_goes_first_even_between_two_transactions(rounds):
    ended = []
    for urgency in (Urgency.SLOW, Urgency.STEERED, Urgency.REPAIR):
        rounds.add(reading(rounds, 11, 7, 11), lambda _, u=urgency: ended.append(u), urgency, "two")
    rounds.gap(READ_NS + 150_000)
    rounds.add(reading(rounds, 12, 7), lambda _: ended.append(Urgency.MODE), Urgency.MODE, "one")
    for _ in range(8):
        rounds.gap(READ_NS + 150_000)
    assert ended == [Urgency.MODE, Urgency.REPAIR, Urgency.STEERED, Urgency.SLOW]


def test_of_one_servo_the_program_that_began_ends_first(rounds):
    ended = []
    for name, urgency, servo in (("a", Urgency.REPAIR, 0), ("b", Urgency.MODE, 0), ("c", Urgency.MODE, 1)):
        servo_id = rounds.rig.plans[0].servos[servo].servo_id
        program = reading(rounds, servo_id, 7, 11, 64)
        rounds.add(program, lambda _, name=name: ended.append(name), urgency, name, servo)
        rounds.gap(READ_NS + 150_000)
    for _ in range(9):
        rounds.gap(READ_NS + 150_000)
    assert ended == ["a", "b", "c"]


def test_a_pause_of_one_program_leaves_the_line_to_the_others(rounds):
    ended = []

    def pausing():
        yield rounds.read(11, 7)
        before = rounds.rig.clock.now_ns()
        reply = yield listen_transaction(5_000_000)
        assert reply.outcome is TransactionOutcome.SENT
        return rounds.rig.clock.now_ns() - before

    rounds.add(pausing(), ended.append, Urgency.MODE, "pausing")
    rounds.add(reading(rounds, 12, 7), ended.append, Urgency.SLOW, "reading")
    for _ in range(8):
        rounds.gap(1_000_000)
    assert ended[0] == [12]
    assert 5_000_000 <= ended[1] <= 7_000_000


@pytest.mark.parametrize(("urgency", "done"), [(Urgency.REPAIR, True), (Urgency.SLOW, False)])
def test_what_is_urgent_is_done_at_last_in_a_gap_too_short_and_what_is_slow_never(rounds, urgency, done):
    found = []
    name = "torque enable of arm_11_joint"
    rounds.add(reading(rounds, 11, 7, 7, 7), found.append, urgency, name, servo=0)
    sent = [len(rounds.gap(READ_NS)) for _ in range(STARVED + 3 * STARVED_AGAIN)]
    assert sum(sent[:STARVED]) == 0
    assert found == ([[11, 11, 11]] if done else [])
    told = rounds.rig.events.of(EventCode.OVERRUN)
    assert len(told) == done
    if done:
        ((source, text),) = told
        assert source == rounds.rig.plans[0].servos[0].joint
        assert text.startswith(f"{name} needs up to 0.4 ms of idle time, but a cycle leaves only 0.3 ms")


def test_what_is_urgent_waits_no_longer_for_a_slow_program_of_its_servo(rounds):
    ended = []
    for name, urgency, addresses in (("slow", Urgency.SLOW, (7, 11)), ("urgent", Urgency.REPAIR, (7,))):
        program = reading(rounds, 11, *addresses)
        rounds.add(program, lambda _, name=name: ended.append(name), urgency, name, 0)
        rounds.gap(READ_NS + 150_000 * (name == "slow"))
    for _ in range(2 * STARVED + STARVED_AGAIN):
        rounds.gap(READ_NS)
    assert ended == ["slow", "urgent"]


def test_every_program_of_a_line_that_is_gone_ends_with_time_outs(rounds):
    found = []
    rounds.add(reading(rounds, 11, 7, 11), found.append, Urgency.MODE, "begun")
    rounds.gap(READ_NS + 150_000)

    def adding(result):
        found.append(result)
        rounds.add(reading(rounds, 12, 7), found.append, Urgency.SLOW, "added")

    rounds.add(reading(rounds, 12, 7), adding, Urgency.SLOW, "not begun")
    rounds.idle.abandon()
    assert found == [[11, TransactionOutcome.TIMEOUT], [TransactionOutcome.TIMEOUT]]
    assert rounds.idle.waiting == 1


def test_a_transaction_that_a_cycle_cut_off_is_asked_again(rounds):
    found = []
    rounds.add(reading(rounds, 11, 7), found.append, Urgency.MODE, "one")
    assert rounds.idle.begin_idle(rounds.rig.clock.now_ns() + 5_000_000)
    rounds.bus.load_job(rounds.idle)
    rounds.bus.process_due(rounds.rig.clock.now_ns())  # sent, and nothing waits for the reply
    rounds.rig.clock.wait_until(rounds.rig.clock.now_ns() + 5_000_000)
    assert rounds.gap(1_000_000) == [protocol2.read_range(11, 7, 1)]
    assert found == [[11]]


def test_a_gap_begins_nothing_on_a_line_that_was_late_until_that_is_forgotten(rounds):
    found = []
    rounds.bus._note_lateness(400_000)  # of its cyclic reply
    rounds.add(reading(rounds, 11, 7), found.append, Urgency.SLOW, "a read")
    assert rounds.gap(READ_NS + 150_000) == []
    assert rounds.bus.late_ns == 400_000
    for _ in range(200):
        rounds.bus._note_lateness(0)
    assert rounds.bus.late_ns < 50_000
    assert len(rounds.gap(READ_NS + 150_000)) == 1
    assert found == [[11]]


def test_one_reply_that_came_a_second_late_does_not_close_the_idle_time_of_the_next_seconds(rounds):
    found = []
    rounds.bus._note_lateness(1_000_000_000)  # the process was not running
    rounds.add(reading(rounds, 11, 7), found.append, Urgency.MODE, "the mode of a servo")
    assert len(rounds.gap(5_000_000)) == 1
    assert found == [[11]]


MS = 1_000_000
SECOND_NS = 1_000_000_000


class Robot:
    """Servos that say what a test puts into their replies."""

    def __init__(self, *plans):
        self.rig = make_rig(*plans)
        self.plans, self.events, self.states = plans, self.rig.events, self.rig.states
        self.servos = [servo for plan in plans for servo in plan.servos]
        self.samples = self.rig.hardware._samples
        self.replies = [bytearray(servo.state.length) for servo in self.servos]
        self.now_ns = SECOND_NS

    def put(self, index, position, velocity, effort):
        """Put raw values into the bytes of a servo, as its control table has them."""
        layout, reply = self.servos[index].state, self.replies[index]
        for place, value in (
            (layout.position, position),
            (layout.velocity, velocity),
            (layout.effort, effort),
        ):
            signed = place.encoding == "twos_complement"
            data = value.to_bytes(place.size, "little", signed=signed)
            reply[place.offset : place.offset + place.size] = data

    def settle(self, fresh, arrived_ns, *, after_ns=10 * MS):
        """Let the replies arrive so long before now, of those that are fresh."""
        self.now_ns += after_ns
        self.samples.follow_modes()
        self.samples.fresh[:] = False
        said = iter(zip(fresh, self.replies, arrived_ns, strict=True))
        for bus, plan in zip(self.samples.buses, self.plans, strict=True):
            for index in range(len(plan.servos)):
                came, reply, age_ns = next(said)
                if came:
                    bus.store_state(index, bytes(reply), self.now_ns - age_ns)
        self.samples.fill_states(self.now_ns)

    def turn(self, *positions, after_ms=10, came=True):
        """Let the servos stand at angles, rad; return which are valid, and where."""
        for index, (servo, angle) in enumerate(zip(self.servos, positions, strict=True)):
            raw = round((angle * servo.direction + servo.reference) / servo.rad_per_tick)
            self.put(index, raw, 0, 0)
        fresh = [True] * (len(positions) - 1) + [came]
        self.settle(fresh, [0] * len(positions), after_ns=after_ms * MS)
        return self.states.valid.tolist(), self.states.position.tolist()


class TestJumps:
    """Positions that no servo can reach."""

    @pytest.fixture
    def robot(self):
        return Robot(make_plan((1, 3)))

    def test_a_fast_servo_is_believed(self, robot):
        for step in range(20):
            assert robot.turn(step * 0.11, -step * 0.11)[0] == [True, True]  # 11 rad/s

    def test_a_jump_is_invalid_and_the_row_keeps_its_value_until_it_can_be_true(self, robot):
        before = robot.turn(0.0, 0.0)[1]
        assert robot.turn(0.0, 1.5) == ([True, False], before)
        seen = [robot.turn(0.0, 1.5)[0][1] for _ in range(20)]
        assert seen.index(True) in range(8, 14)  # 1.5 rad at 11.9 rad/s
        assert all(seen[seen.index(True) :])
        ((source, text),) = robot.events.of(EventCode.IMPLAUSIBLE)
        assert source == "main_3_joint"
        assert "jumped by 86 deg in 10 ms" in text
        assert REPORT_AGAIN_NS == SECOND_NS

    def test_who_was_not_seen_for_long_may_be_elsewhere(self, robot):
        robot.turn(0.0, 0.0)
        assert robot.turn(2.0, 0.0, after_ms=500)[0] == [True, True]

    def test_a_servo_with_a_profile_is_no_faster_than_its_velocity_limit_can_be(self):
        robot = Robot(make_plan((1, 3), model="XM430-W350", protocol=2.0))
        before = robot.turn(0.0, 0.0)[1]
        assert robot.turn(0.0, 1.5) == ([True, False], before)

    def test_a_joint_over_many_turns_jumps_only_after_a_reboot(self):
        robot = Robot(make_x((1, 3), continuous=True, lower=-np.inf, upper=np.inf))
        robot.turn(40.0, 40.0)
        assert robot.turn(0.0, 40.0)[0] == [False, True]
        robot.samples.buses[0].restart_count(0)
        assert robot.turn(0.0, 40.0)[0] == [True, True]

    def test_a_row_looks_no_younger_for_a_reply_that_was_not_believed(self, robot):
        robot.turn(0.0, 0.0)
        robot.turn(0.0, 1.5)
        robot.turn(0.0, 0.0, came=False)
        assert not robot.states.valid[1]
        assert robot.states.age_ns.tolist() == [0, 20 * MS]


@pytest.mark.parametrize("reason", Reason)
def test_each_reason_of_the_wire_is_an_event(reason: Reason) -> None:
    events = Events()
    WireReports(events).report(reason, "main", "a sentence")
    ((_, _, source, text),) = events.list
    assert (source, text) == ("main", "a sentence")
