"""Samples: the states of joints that the replies of a cycle make, and positions that are not believed."""

import numpy as np
import pytest
from tests.kit.rigs import make_plan, make_rig, make_x

from dxlrun.channels.event_records import EventCode
from dxlwire.exchange.samples import REPORT_AGAIN_NS

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

    def all_said(self, *raw, age_ns=0):
        """Let every servo say the same."""
        for index in range(len(self.servos)):
            self.put(index, *raw)
        count = len(self.servos)
        self.settle([True] * count, [age_ns] * count)

    def turn(self, *positions, after_ms=10, came=True):
        """Let the servos stand at angles, rad; return which are valid, and where."""
        for index, (servo, angle) in enumerate(zip(self.servos, positions, strict=True)):
            raw = round((angle * servo.direction + servo.reference) / servo.rad_per_tick)
            self.put(index, raw, 0, 0)
        fresh = [True] * (len(positions) - 1) + [came]
        self.settle(fresh, [0] * len(positions), after_ns=after_ms * MS)
        return self.states.valid.tolist(), self.states.position.tolist()


def test_signs_follow_the_joints_direction():
    robot = Robot(make_plan())
    robot.all_said(512, 100, 1024 + 200, age_ns=30)  # counter-clockwise 100; clockwise 200
    servo = robot.servos[0]
    direction = np.array([one.direction for one in robot.servos])
    assert robot.states.position == pytest.approx([one.joint_position(512) for one in robot.servos])
    assert robot.states.velocity == pytest.approx(direction * 100 * servo.rad_s_per_tick)
    assert robot.states.effort == pytest.approx(direction * -200 / 1023)
    assert robot.states.age_ns.tolist() == [30] * 8


def test_a_lost_row_keeps_its_own_values_and_ages():
    robot = Robot(make_plan())
    states = robot.states
    for index in range(8):
        robot.put(index, 100 + index, 0, 0)
    robot.settle(np.arange(8) != 3, [0] * 8)
    assert np.isnan(states.position[3])
    assert states.age_ns[3] == -1
    robot.settle([True] * 8, [0] * 8)
    kept = states.position.copy()
    for index in range(8):
        robot.put(index, 90, 0, 0)
    robot.settle(np.arange(8) != 5, [0] * 8)
    assert states.position[5] == kept[5]
    assert not states.valid[5]
    assert states.age_ns[5] == 10 * MS
    assert (states.position != kept).sum() == 7


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
