"""Torque and reboots that clients request, judged by the simulated bus: its ledger, its servos' memory."""

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.line_faults import turn_by_hand
from tests.kit.rigs import make_plan, make_rig, make_x, start_rig

from dxlrun.channels.cycle import Torque
from dxlrun.channels.event_records import EventCode, Severity
from dxlrun.dynamixel.servo.life import ServoState
from dxlrun.errors import StartUpError
from dxlwire.modes import Mode
from dxlwire.wire import protocol2

PROTOCOLS = (1.0, 2.0)
IDS = (11, 12, 13)


class Arm:
    """Three servos that hold, and what was answered."""

    def __init__(self, protocol=2.0, *, watchdog=0, **change):
        returning = change.pop("returning", False)
        limp = change.pop("limp", ())
        take_over = change.pop("take_over", False)
        limits = {"name": "arm", "return_delay_ns": 0, "lower": -2.5, "upper": 2.5}
        plan = make_plan(IDS, **limits | change) if protocol == 1.0 else make_x(IDS, **change)
        servos = tuple(
            replace(servo, torque_on_return=returning, torque_at_start=servo.servo_id not in limp)
            for servo in plan.servos
        )
        self.plan = replace(plan, servos=servos, watchdog_ticks=watchdog)
        self.protocol = protocol
        self.rig = make_rig(self.plan, take_over=take_over)
        self.answers = {}
        self.asked = 0

    def start(self):
        self.rig.hardware.start()
        return self

    def let_go(self):
        """Start, and switch the torque of the second one off."""
        self.start()
        assert self.told(self.switch(False)) == ""
        return self

    @property
    def servo(self):
        return self.rig.servo(12)

    @property
    def state(self):
        return self.rig.hardware._servos[0].life.states[1]

    @property
    def shown(self):
        return [Torque(one) for one in self.rig.states.torque.tolist()]

    def follow(self, count):
        """Run cycles in which the goal of a limp joint is where it stands, as the gate has it."""
        for _ in range(count):
            limp = np.isin(self.rig.states.torque, (Torque.OFF, Torque.RELEASED))
            np.copyto(self.rig.goals.position, self.rig.states.position, where=limp)
            self.rig.cycle()

    def _answer(self):
        self.asked += 1
        return lambda problem, number=self.asked: self.answers.setdefault(number, []).append(problem)

    def switch(self, on, row=1):
        self.rig.hardware.switch_torque(row, on, self._answer())
        return self.asked

    def reboot(self, row=1):
        self.rig.hardware.reboot_servo(row, self._answer())
        return self.asked

    def told(self, number, most=300):
        """Run cycles until a request is answered; return what went wrong."""
        for _ in range(most):
            if number in self.answers:
                (answer,) = self.answers[number]
                return answer
            self.follow(1)
        raise AssertionError("it was not answered")

    def torque_bytes(self, since=0):
        address = self.plan.servos[0].torque_address
        return [(servo, data[0]) for servo, at, data in self.rig.writes(since) if at == address]


def goals_to(arm, since):
    """Return the IDs that sync writes of goals named."""
    return {one for address, ids in arm.rig.goals_sent(since) if address != 98 for one in ids}


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_one_joint_is_limp_while_the_others_hold(protocol):
    arm = Arm(protocol).start()
    arm.rig.restless = 0.02
    begun = len(arm.rig.into_bus())
    number = arm.switch(False)
    assert arm.told(number) == ""
    assert arm.torque_bytes(begun) == [(12, 0)]
    arm.rig.cycles(2)
    assert arm.shown == [Torque.ON, Torque.RELEASED, Torque.ON]
    since = len(arm.rig.into_bus())
    arm.rig.cycles(60)
    assert goals_to(arm, since) == {11, 13}
    assert arm.rig.torque() == [True, False, True]
    assert arm.rig.states.valid.all()


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_torque_on_holds_a_joint_where_a_person_has_put_it(protocol):
    arm = Arm(protocol).let_go()
    turn_by_hand(arm.servo, 2.4)
    arm.follow(5)
    begun = len(arm.rig.into_bus())
    assert arm.told(arm.switch(True)) == ""
    arm.follow(3)
    place = arm.rig.states.position[1]
    assert arm.torque_bytes(begun) == [(12, 1)]
    arm.follow(40)
    assert abs(arm.rig.states.position[1] - place) < 0.02
    assert arm.rig.torque() == [True, True, True]
    assert arm.shown == [Torque.ON] * 3
    assert arm.state is ServoState.TORQUED
    written = [address for servo, address, _ in arm.rig.writes(begun) if servo == 12]
    assert written[-1] == arm.plan.servos[1].torque_address, "its goal came behind its torque"


def test_the_bus_watchdog_is_armed_when_torque_is_on_again():
    arm = Arm(watchdog=10).let_go()
    arm.rig.clock.wait_until(arm.rig.clock.now_ns() + 400_000_000)  # the others are stopped, and revived
    arm.follow(20)
    assert arm.told(arm.switch(True)) == ""
    assert arm.rig.registers("bus_watchdog") == [10] * 3
    arm.follow(30)
    assert arm.shown == [Torque.ON] * 3


def test_a_joint_that_the_file_wants_limp_loses_the_torque_that_it_has():
    arm = Arm(limp=(12,), take_over=True)
    for servo in arm.rig.buses[0].servos:
        servo.poke("torque_enable", 1)
    arm.start()
    assert arm.rig.torque() == [True, False, True]
    assert (12, 0) in arm.torque_bytes()
    other = Arm(limp=(12,), take_over=True)
    other.servo.poke("torque_enable", 1)
    other.servo.registers.watch_items(("torque_enable",), lambda: other.servo.poke("torque_enable", 1))
    with pytest.raises(StartUpError, match="did not confirm that its torque is off"):
        other.start()


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_servo_that_resets_after_torque_on_gets_no_goal(protocol):
    """Its torque is read once more before its first goal, which may switch its torque on."""
    arm = Arm(protocol).let_go()
    arm.rig.restless = 0.02
    assert arm.told(arm.switch(True)) == ""
    arm.servo.poke("torque_enable", 0)
    begun = len(arm.rig.into_bus())
    arm.follow(30)
    assert goals_to(arm, begun) == {11, 13}
    assert arm.rig.torque() == [True, False, True]


def test_torque_off_that_was_not_heard_is_written_again_and_one_that_is_never_heard_is_named():
    arm = Arm().start()
    written = arm.rig.torque_given(12)
    arm.servo.registers.watch_items(
        ("torque_enable",), lambda: len(written) == 1 and arm.servo.poke("torque_enable", 1)
    )
    assert arm.told(arm.switch(False)) == ""
    assert arm.rig.torque() == [True, False, True]
    arm = Arm().start()
    arm.rig.stick(12, "torque_enable", 1)
    assert arm.told(arm.switch(False)).endswith("did not confirm torque off; dxlrun sends it again")


def test_a_joint_that_was_let_go_stays_limp_when_its_mode_changes_or_the_line_is_pulled():
    arm = Arm(returning=True).let_go()
    given = arm.rig.torque_given(12)
    arm.rig.set_modes(0, Mode.VELOCITY, 0)
    arm.follow(20)
    assert arm.rig.states.mode[1] == Mode.VELOCITY
    arm.rig.buses[0].unplug()
    arm.rig.cycles(5)
    arm.rig.buses[0].plug_in()
    arm.follow(150)
    assert not any(given)
    assert arm.shown == [Torque.ON, Torque.RELEASED, Torque.ON]


def test_torque_off_while_the_mode_changes_wins():
    arm = Arm().start()
    arm.rig.set_modes(0, Mode.VELOCITY, 0)
    number = arm.switch(False)
    assert arm.told(number) == ""
    arm.follow(20)
    assert arm.rig.torque() == [True, False, True]
    assert arm.rig.states.mode[1] == Mode.VELOCITY
    assert arm.told(arm.switch(True)) == ""
    arm.follow(5)
    assert arm.rig.torque() == [True] * 3


def test_torque_on_that_waits_behind_a_mode_is_done_in_the_new_one():
    arm = Arm().let_go()
    arm.rig.set_modes(0, Mode.VELOCITY, 0)
    assert arm.told(arm.switch(True)) == ""
    assert arm.servo.registers["operating_mode"] == 1
    assert arm.servo.registers["goal_velocity"] == 0
    assert arm.rig.torque() == [True] * 3


def _shut_down(arm):
    arm.servo.trigger_overload()
    arm.follow(10)


def test_torque_on_a_servo_of_protocol_1_that_shut_down_says_what_helps():
    arm = Arm(1.0).start()
    _shut_down(arm)
    problem = arm.told(arm.switch(True))
    assert "(ID 12 on bus arm)" in problem
    assert "switch its power off and on" in problem
    assert "reboot" not in problem
    assert "has no reboot instruction: switch its power off and on" in arm.told(arm.reboot())


@pytest.mark.parametrize("watchdog", [0, 10])
def test_a_servo_that_held_holds_again_after_its_reboot(watchdog):
    arm = Arm(watchdog=watchdog).start()
    place, begun = arm.rig.states.position[1], len(arm.rig.into_bus())
    assert arm.told(arm.reboot()) == ""
    packets = [packet for packet in arm.rig.into_bus()[begun:] if packet[7] == 8]
    assert [packet[4] for packet in packets] == [12]
    arm.follow(30)
    assert arm.rig.torque() == [True] * 3
    assert arm.shown == [Torque.ON] * 3
    assert abs(arm.rig.states.position[1] - place) < 0.02
    assert arm.servo.registers["bus_watchdog"] == watchdog
    rebooted = [(s, t) for code, s, _, t in arm.rig.events.list if code == EventCode.SERVO_REBOOTED]
    assert rebooted == [(Severity.INFO, "arm_12_joint (ID 12 on bus arm) rebooted, as requested")] or [
        s for s, _ in rebooted
    ] == [Severity.INFO]
    assert not arm.rig.events.of(EventCode.SERVO_LOST)


def without_torque(arm):
    """Let a servo lose its torque for a while, so that it is limp by no request."""
    arm.servo.poke("torque_enable", 0)
    arm.servo.wakes_on_goal = False
    arm.servo.silence()
    arm.rig.cycles(2)
    arm.servo.silence(False)
    arm.follow(20)
    assert arm.state is ServoState.LIMP


def test_a_limp_servo_that_is_lost_twice_gets_no_torque_when_it_is_back():
    """The policy gives torque back after a reboot, and torque that was there and is off may show one."""
    arm = Arm(returning=True).start()
    without_torque(arm)
    life = arm.rig.hardware._servos[0].life
    assert not life.lose(1).had_torque
    assert not life.lose(1).had_torque
    arm.rig.hardware._look = True  # the cycles in between need not look at a servo at rest
    arm.follow(120)
    assert arm.state is ServoState.LIMP
    assert arm.rig.torque() == [True, False, True]


def test_a_limp_servo_that_refuses_a_mode_gets_no_torque():
    arm = Arm(1.0).let_go()
    begun = len(arm.rig.into_bus())
    arm.servo.poke("lock", 1)
    arm.rig.set_modes(0, Mode.VELOCITY, 0)
    arm.follow(40)
    assert any("was not written" in text for text in arm.rig.events.texts(EventCode.MODE))
    assert (12, 1) not in arm.torque_bytes(begun)
    assert arm.rig.torque() == [True, False, True]


def test_requests_on_a_line_that_is_gone_are_answered():
    arm = Arm().start()
    assert arm.told(arm.switch(False, row=0)) == ""
    arm.rig.buses[0].unplug()
    numbers = [arm.switch(False), arm.switch(True, row=0), arm.reboot(row=2)]
    assert all(arm.told(number) for number in numbers)
    arm.rig.buses[0].plug_in()
    arm.follow(200)
    assert not arm.rig.torque()[1]


def test_a_servo_that_reboots_while_it_is_checked_gets_no_torque():
    """At any packet from the first reading of its clock, before the check, to the second, before torque."""
    arm = Arm(returning=True).let_go()
    begun = len(arm.rig.into_bus())
    assert arm.told(arm.switch(True)) == ""
    tick = protocol2.read_range(12, 120, 2)
    first, last = (number for number, packet in enumerate(arm.rig.into_bus()[begun:]) if packet == tick)
    assert last - first > 5
    for packets in range(first + 1, last + 1):
        arm = Arm(returning=True).let_go()
        given = arm.rig.torque_given(12)
        begun = len(arm.rig.into_bus())
        number = arm.switch(True)
        arm.rig.buses[0].after(packets, arm.servo.power_cycle)
        assert "rebooted during the check" in arm.told(number), packets
        assert (12, 1) not in arm.torque_bytes(begun)
        arm.follow(100)
        assert not any(given)


@pytest.mark.parametrize("returning", [False, True])
@pytest.mark.parametrize("after", range(1, 14))
def test_a_servo_that_reboots_while_its_mode_changes_gets_torque_by_the_policy_alone(returning, after):
    arm = Arm(returning=returning).start()
    arm.rig.set_modes(0, Mode.VELOCITY, 0)
    arm.rig.buses[0].after(after + 2, arm.servo.power_cycle)
    arm.follow(150)
    assert arm.rig.torque() == [True, returning, True]
    assert arm.rig.states.mode[1] == Mode.VELOCITY


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("limp", [(12,), IDS])
def test_joints_that_the_file_wants_limp_get_no_torque_at_the_start(protocol, limp):
    arm = Arm(protocol, limp=limp)
    turn_by_hand(arm.servo, 3.0)
    arm.start()
    assert not any(on for servo, on in arm.torque_bytes() if servo in limp)
    arm.follow(30)
    assert arm.rig.torque() == [servo not in limp for servo in IDS]
    assert arm.rig.states.valid.all()
    assert arm.shown[1] is Torque.RELEASED
    assert arm.told(arm.switch(True)) == ""
    arm.follow(3)
    assert arm.rig.torque()[1]
    assert arm.rig.hardware.stop() == ()
    assert arm.rig.torque() == [False] * 3


def test_a_limp_joint_may_stand_outside_its_limits_at_the_start():
    for arm in (Arm(limp=(12,)), Arm()):
        plan = arm.plan.servos[1]
        turn_by_hand(arm.servo, (plan.upper_tick + 40) * plan.rad_per_tick)
        if not plan.torque_at_start:
            arm.start()
            assert arm.rig.torque() == [True, False, True]
            continue
        with pytest.raises(StartUpError, match="outside its limits"):
            arm.start()


def test_twenty_joints_at_once():
    ids = tuple(range(1, 21))
    rig = start_rig(make_x(ids))
    answers = []
    for on in (False, True):
        for row in range(20):
            rig.hardware.switch_torque(row, on, answers.append)
        for _ in range(200):
            limp = np.isin(rig.states.torque, (Torque.OFF, Torque.RELEASED))
            np.copyto(rig.goals.position, rig.states.position, where=limp)
            rig.cycle()
            if len(answers) == 20:
                break
        assert answers == [""] * 20
        assert rig.torque() == [on] * 20
        answers.clear()


@pytest.mark.parametrize(
    ("item", "said"),
    [("torque_enable", "has goal "), ("bus_watchdog", "has Bus Watchdog (98) = 0 after 10 was written")],
)
def test_a_servo_that_does_not_take_torque_or_its_watchdog_is_limp_and_named(item, said):
    arm = Arm(watchdog=10).let_go()
    arm.rig.stick(12, item, 0)
    assert arm.told(arm.switch(True)).startswith(f"arm_12_joint (ID 12 on bus arm) {said}")
    arm.follow(1)
    assert arm.rig.torque() == [True, False, True]
    assert arm.shown[1] is Torque.RELEASED


def test_torque_on_of_a_servo_in_doubt_is_read():
    arm = Arm(1.0).start()
    arm.servo.silence()
    arm.rig.cycle(idle=False)
    arm.servo.silence(False)
    arm.servo.poke("torque_enable", 0)
    assert arm.state is ServoState.HOLDING
    assert "did not confirm its torque" in arm.told(arm.switch(True))


@pytest.mark.parametrize("released", ["before", "meanwhile", ""])
def test_a_lost_servo_changes_its_mode_when_it_is_back_and_gets_no_torque_if_released(released):
    """Its watchdog stopped it meanwhile, so it would refuse a goal in the new mode before it is cleared."""
    arm = Arm(watchdog=10).start()
    arm.rig.cycles(20)
    if released == "before":
        arm.switch(on=False)
        arm.rig.cycles(5)
    arm.servo.silence(True)
    arm.rig.cycles(20)
    assert arm.state is ServoState.OFFLINE
    if released == "before":
        arm.servo.poke("torque_enable", 1)  # as if its torque off had got lost
    elif released:
        arm.switch(on=False)
    arm.rig.set_modes(0, Mode.VELOCITY, 0)
    arm.rig.cycles(5)
    given = arm.rig.torque_given(12)
    arm.servo.silence(False)
    arm.rig.cycles(150)
    assert arm.rig.states.mode[1] == Mode.VELOCITY
    assert arm.shown[1] is (Torque.RELEASED if released else Torque.ON)
    assert arm.rig.torque() == [True, not released, True]
    assert not (released and any(given))
