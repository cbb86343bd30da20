"""A servo that stops answering holds its own controllers, no others; what takes over from a controller."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import pytest
from tests.kit.line_faults import truncate_next
from tests.kit.wire import all_writes

from dxlrun.channels.answers import Completion
from dxlrun.channels.commands import LOOP, CommandMessage
from dxlrun.channels.cycle import States
from dxlrun.channels.event_records import EventBody, EventCode
from dxlrun.features.lost_servos import GroupPolicy, LostServos, MissedReplies
from dxlrun.plan.policy_plan import LIMP, PolicyPlan
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun.testing import read_log, simulated_robot
from dxlrun_controllers.group import JointGroupPositionController

ROBOT = """\
name: three
buses:
  main: {port: sim, protocol: 1.0, baud_rate: 1_000_000, return_delay_time: 100 us, adapter: {latency: 1 ms}}
loop: {rate: 50}
joints:
  pan: {bus: main, id: 3, model: AX-12A, reference: 150 deg, direction: 1}
  tilt: {bus: main, id: 7, model: AX-12A, reference: 150 deg, direction: 1}
  yaw: {bus: main, id: 9, model: AX-12A, reference: 150 deg, direction: 1}
controllers:
  states: {type: joint_state_broadcaster}
  pair: {type: joint_group_position_controller, joints: [pan, tilt], fallback: calm}
  single: {type: joint_group_position_controller, joints: [yaw]}
  calm: {type: joint_group_position_controller, joints: [pan, tilt], active: false, fallback: pair}
"""
PERIOD_NS = 20_000_000
TICK = math.radians(300 / 1023)
GONE_NS, BACK_NS = 500_000_000, 1_500_000_000
Act = Callable[[Any, int], None]


def sway(controller: Any, time_ns: int) -> None:
    """Move all joints of a controller, 3 rad/s at the most."""
    controller.context.commands.position[:] = math.sin(3 * time_ns * 1e-9)


def give_up(controller: Any, time_ns: int) -> None:
    """Break the contract after a while."""
    if time_ns >= GONE_NS:
        raise ValueError(f"{controller.context.name} gave up")
    sway(controller, time_ns)


@pytest.fixture
def built(tmp_path):
    """Build the robot on virtual time, with a log."""

    def build(duration_s=2.5, more=""):
        path = tmp_path / "three.yaml"
        path.write_text(ROBOT + more)
        return simulated_robot(path, duration_s=duration_s, log=tmp_path / "run.mcap")

    return build


def goals(robot: VirtualRobot, servo: int) -> list[tuple[int, float]]:
    """Return the goals that a servo got in cycles, with a speed: time and rad."""
    return [
        (t_ns, int.from_bytes(data[:2], "little") * TICK)
        for t_ns, one, address, data in all_writes(robot.ledger.entries, robot.plan.buses[0])
        if (one, address, len(data)) == (servo, 30, 4)
    ]


def swing(sent: list[tuple[int, float]], begin_ns: int, end_ns: int) -> float:
    """Return how far goals went from one another between two times, rad; one that stays is sent rarely."""
    angles = [angle for t, angle in sent if begin_ns < t < end_ns]
    return max(angles) - min(angles) if angles else 0.0


def lose_tilt(robot: VirtualRobot) -> None:
    servo = robot.buses[0].servo(7)
    robot.buses[0].at(GONE_NS, servo.silence)
    robot.buses[0].at(BACK_NS, lambda: servo.silence(False))


def test_controllers_of_a_lost_servo_are_held_and_the_others_go_on(built, acts, tmp_path):
    acts |= {"pair": sway, "single": sway}
    robot = built()
    lose_tilt(robot)
    assert robot.run().reason == "ended"
    lost_ns = GONE_NS + 4 * PERIOD_NS
    assert swing(goals(robot, 3), lost_ns, BACK_NS) == 0
    assert [t for t, _ in goals(robot, 7) if lost_ns < t < BACK_NS] == []
    assert swing(goals(robot, 9), lost_ns, BACK_NS) > 0.5
    free = [angle for t, angle in goals(robot, 9) if lost_ns < t < BACK_NS]
    assert max(abs(b - a) for a, b in itertools.pairwise(free)) > 1.5 * 0.02 + TICK, "yaw was slowed down"
    told = [event.text for event in read_log(tmp_path / "run.mcap").events if event.code == EventCode.POLICY]
    assert told == ["is held until all its joints answer again", "resumes: all its joints answer again"]


def test_a_controller_goes_on_slowly_when_its_servo_answers_again(built, acts):
    acts |= {"pair": sway, "single": sway}
    robot = built()
    lose_tilt(robot)
    robot.run()
    after = [(t, angle) for t, angle in goals(robot, 3) if t > BACK_NS]
    assert swing(goals(robot, 3), BACK_NS + 500_000_000, 10 * BACK_NS) > 0.5
    slow = [(t, angle) for t, angle in after if t < BACK_NS + 900_000_000]
    steps = [abs(angle - before) for (_, before), (_, angle) in itertools.pairwise(slow)]
    assert max(steps) <= 1.5 * 0.02 + TICK
    eased = [angle for t, angle in goals(robot, 9) if BACK_NS < t < BACK_NS + 900_000_000]
    assert max(abs(b - a) for a, b in itertools.pairwise(eased)) > 1.5 * 0.02 + TICK, (
        "yaw was not slowed down"
    )


def test_two_missed_replies_hold_no_joint(built, acts, tmp_path):
    acts |= {"pair": sway}
    robot = built(1.0)
    robot.buses[0].at(GONE_NS, lambda: [truncate_next(robot.buses[0], 7, 0) for _ in range(2)])
    robot.run()
    assert not [one for one in read_log(tmp_path / "run.mcap").events if one.code == EventCode.POLICY]


def test_a_command_does_not_wake_a_controller_whose_servo_is_lost(built):
    robot = built(1.2)
    lose_tilt(robot)
    command = CommandMessage(1, "pair", "positions", bytes(8) + bytes(8), "anna")
    shifted = CommandMessage(1, "pair", "positions", b"\0\0\0\0\0\0\xe0?" * 2, "anna")  # 0.5 rad
    robot.buses[0].at(GONE_NS - 100_000_000, lambda: robot.inbox.waiting.append(command))
    robot.buses[0].at(GONE_NS + 200_000_000, lambda: robot.inbox.waiting.append(shifted))
    robot.run()
    assert isinstance(robot.inbox.answers[1], Completion)
    assert swing(goals(robot, 3), GONE_NS, BACK_NS) == 0


def test_a_controller_that_is_activated_while_its_servo_is_lost_waits_for_it_too(built, acts):
    acts |= {"calm": sway}
    robot = built(2.5)
    lose_tilt(robot)
    switch = CommandMessage(1, LOOP, "switch", b'{"activate":["calm"],"deactivate":["pair"]}', "anna")
    robot.buses[0].at(GONE_NS + 200_000_000, lambda: robot.inbox.waiting.append(switch))
    robot.run()
    assert isinstance(robot.inbox.answers[1], Completion)
    assert swing(goals(robot, 3), GONE_NS, BACK_NS) == 0
    assert swing(goals(robot, 3), BACK_NS, 10 * BACK_NS) > 0.5


def test_a_fallback_takes_over_in_the_same_cycle_and_the_run_goes_on(built, acts, tmp_path):
    taken: list[int] = []
    acts |= {"pair": give_up, "calm": lambda controller, time_ns: taken.append(time_ns)}
    robot = built(1.0)
    assert robot.run().reason == "ended"
    log = read_log(tmp_path / "run.mcap")
    masks = log.cycles["active"].tolist()
    assert {mask & 0b1010 for mask in masks} == {0b0010, 0b1000}
    fault = next(event for event in log.events if event.code == EventCode.CONTROLLER_FAULT)
    assert (fault.source, "pair gave up" in fault.text) == ("pair", True)
    assert swing(goals(robot, 3), GONE_NS + 3 * PERIOD_NS, 10 * GONE_NS) < 2 * TICK
    assert taken


def test_two_that_fall_back_on_each_other_end_the_run_when_both_have_failed(built, acts):
    acts |= {"pair": give_up, "calm": give_up}
    result = built(1.0).run()
    assert result.reason == "fault"
    assert "calm gave up" in result.detail


def test_no_controller_takes_over_from_one_that_fails_while_it_leaves(built, monkeypatch):
    def leave(controller, time_ns):
        raise ValueError("not like this")

    monkeypatch.setattr(JointGroupPositionController, "on_deactivate", leave)
    robot = built(0.2)
    result = robot.run()
    assert result.reason == "fault"
    assert robot.robot.manager.active == ()


def test_a_servo_that_flickers_holds_and_frees_its_controllers_each_time_and_moves_slowly(
    built, acts, tmp_path
):
    acts |= {"pair": sway, "single": sway}
    robot = built()
    servo = robot.buses[0].servo(7)
    for turn in range(4):  # five replies are lost, then it is looked at, and a few come
        robot.buses[0].at(GONE_NS + turn * 400_000_000, servo.silence)
        robot.buses[0].at(GONE_NS + turn * 400_000_000 + 100_000_000, lambda: servo.silence(False))
    assert robot.run().reason == "ended"
    told = [event.text for event in read_log(tmp_path / "run.mcap").events if event.code == EventCode.POLICY]
    assert told == ["is held until all its joints answer again", "resumes: all its joints answer again"] * 4
    sent = [one for one in goals(robot, 3) if GONE_NS + 100_000_000 < one[0] < GONE_NS + 1_600_000_000]
    steps = [
        abs(b - a) for (_, a), (_, b) in itertools.pairwise(sent)
    ]  # one a cycle, however late it is sent
    assert 0.02 < max(steps) < 0.03 + TICK


def test_a_pose_at_the_end_does_not_wait_for_a_servo_that_is_lost(built, acts, tmp_path):
    more = "poses: {home: {pan: 20 deg, tilt: 20 deg, yaw: 20 deg}}\n"
    more += "policies: {on_exit: [{pose: home, speed: 60 deg/s}, limp], exit_timeout: 8 s}\n"
    robot = built(more=more)
    robot.buses[0].at(GONE_NS, robot.buses[0].servo(7).silence)
    robot.buses[0].at(BACK_NS, robot.stop.request)
    result = robot.run()
    assert (result.reason, result.last) == ("stopped", "limp")
    assert robot.clock.now_ns() < BACK_NS + 1_500_000_000, "it waited for the lost one"
    ended = round(math.radians(170) / TICK) * TICK
    assert [goals(robot, servo)[-1][1] for servo in (3, 9)] == pytest.approx([ended, ended])


def test_all_joints_of_a_group_lose_their_torque_with_one_of_its_servos(built, tmp_path):
    robot = built(1.5, "policies: {groups: {neck: {joints: [pan, tilt], on_lost_servo: limp}}}\n")
    pan, tilt, yaw = (robot.buses[0].servo(servo_id) for servo_id in (3, 7, 9))
    had = []
    robot.buses[0].at(GONE_NS, tilt.silence)
    robot.buses[0].at(GONE_NS, lambda: had.extend((pan.torque_on, yaw.torque_on)))
    robot.buses[0].at(GONE_NS + 500_000_000, lambda: had.extend((pan.torque_on, yaw.torque_on)))
    assert robot.run().reason == "ended"
    assert had == [True, True, False, True]
    (told,) = [event.text for event in read_log(tmp_path / "run.mcap").events if "group" in event.text]
    assert told == "group neck lost a servo: the group is limp until a client requests torque"


def test_the_first_reason_to_end_a_run_decides_by_which_policy(built):
    robot = built(
        1.5,
        "policies: {on_lost_servo: [{reduce_torque: 0.5, steps: 2, over: 100 ms}, hold], on_fault: limp,"
        " groups: {neck: {joints: [tilt], on_lost_servo: stop}}}\n",
    )
    for servo_id in (3, 7):
        robot.buses[0].at(GONE_NS, robot.buses[0].servo(servo_id).silence)
    result = robot.run()
    assert (result.reason, result.last) == ("fault", "hold")
    assert result.detail.startswith("pan missed at least 3 replies in a row; on_lost_servo: ")
    assert robot.buses[0].servo(9).torque_on


MISSED, HEARD = False, True


@pytest.mark.parametrize(
    ("cycles", "lost"),
    [
        ([(MISSED, 20), (MISSED, 40), (MISSED, 60)], [False, False, True]),
        ([(MISSED, 47), (MISSED, 48), (MISSED, 49), (MISSED, 50)], [False, False, False, True]),  # at 1 kHz
        (
            [(MISSED, 100), (MISSED, 200), (HEARD, 0), (MISSED, 100), (MISSED, 200), (MISSED, 300)],
            [False, False, False, False, False, True],
        ),
        ([(MISSED, -1), (MISSED, -1), (MISSED, -1)], [False, False, True]),  # never heard
        ([(MISSED, 100), (MISSED, 200), (MISSED, 300), (HEARD, 0)], [False, False, True, False]),
    ],
)
def test_a_joint_is_lost_after_three_misses_in_a_row_and_some_time(cycles, lost):
    missed, states, found = MissedReplies(2), States.empty(2), []
    states.valid[:] = True
    before = frozenset[int]()
    for heard, age_ms in cycles:
        states.valid[1], states.age_ns[1] = heard, age_ms * 1_000_000 if age_ms > 0 else age_ms
        assert missed.count(states) is (missed.lost != before)
        before = missed.lost
        found.append(1 in missed.lost)
        assert 0 not in missed.lost
    assert found == lost


class NotedActions:
    """Notes what a monitor does to a run."""

    def __init__(self, policies: PolicyPlan) -> None:
        self.policies = policies
        self.done: list[tuple[str, object]] = []

    def end_run(self, policy: str, why: str) -> None:
        self.done.append((policy, why))

    def make_limp(self, rows: frozenset[int]) -> None:
        self.done.append(("limp", set(rows)))

    def hold_controllers(self, holder: object, lost: frozenset[int], until: str) -> None:
        self.done.append(("hold", set(lost)))

    def report(self, event: EventBody) -> None:
        self.done.append((event.severity.name, event.text))


def test_group_becomes_limp_once_however_long_its_servo_stays_away():
    arm = GroupPolicy("arm", frozenset({0, 1}), "limp")
    states, actions = States.empty(3), NotedActions(PolicyPlan())
    monitor = LostServos(("a", "b", "c"), states, actions, (arm,))
    states.age_ns[:] = 100_000_000
    for lost in [(0,)] * 5 + [(0, 1)] * 5 + [()] * 2 + [(0,)] * 5:
        states.valid[:] = True
        states.valid[[*lost]] = False
        monitor.check_cycle(0)
    sentence = "group arm lost a servo: the group is limp until a client requests torque"
    held = [("hold", {0}), ("hold", {0, 1}), ("hold", set()), ("hold", {0})]
    assert actions.done == [("limp", {0, 1}), ("ERROR", sentence), *held]


@pytest.mark.parametrize(
    ("own", "policy"), [(None, "on_lost_servo"), ("stop", "on_fault"), ("hold", ""), ("limp", "")]
)
def test_a_lost_servo_of_a_group_ends_the_run_by_on_fault_if_the_group_says_stop(own, policy):
    groups = () if own is None else (GroupPolicy("arm", frozenset({0}), own),)
    states, actions = States.empty(1), NotedActions(PolicyPlan(of_features={"on_lost_servo": LIMP}))
    monitor = LostServos(("a",), states, actions, groups)
    states.age_ns[:] = 100_000_000
    for _ in range(3):
        monitor.check_cycle(0)
    ending = [(policy, "a missed at least 3 replies in a row")] if policy else [("hold", {0})]
    assert actions.done[-1:] == ending
    assert [name for name, _ in actions.done if name.startswith("on_")] == [policy] * bool(policy)
