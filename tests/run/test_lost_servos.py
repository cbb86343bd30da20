"""A servo that stops answering holds its own controllers, no others; what takes over from a controller."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest
from tests.kit.sampled_run import SampledRun, texts
from tests.kit.stories import send, switch

from dxlrun.channels.cycle import States
from dxlrun.channels.event_records import EventBody, EventCode
from dxlrun.features.lost_servos import GroupPolicy, LostServos, MissedReplies
from dxlrun.plan.policy_plan import LIMP, PolicyPlan
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
GOAL_POSITION = 30
GONE_NS, BACK_NS = 500_000_000, 1_500_000_000


def sway(controller: Any, time_ns: int) -> None:
    """Move all joints of a controller, 3 rad/s at the most."""
    controller.context.commands.position[:] = math.sin(3 * time_ns * 1e-9)


@pytest.fixture
def built(tmp_path):
    return lambda seconds=2.5, more="": SampledRun(tmp_path, ROBOT + more, seconds)


def goals(run: SampledRun, joint: str, begin_ns: float = 0, end_ns: float = math.inf) -> list[float]:
    """Return the goals that a joint got in cycles in a time, with a speed; rad."""
    sent = [(at * 1e6, value & 0xFFFF) for at, value in run.goals(joint, GOAL_POSITION, 4)]
    return [ticks * TICK for at_ns, ticks in sent if begin_ns < at_ns < end_ns]


def swing(sent: list[float]) -> float:
    """Return how far goals went from one another, rad; one that stays is sent rarely."""
    return max(sent) - min(sent) if sent else 0.0


def largest_step(sent: list[float]) -> float:
    return max(abs(after - before) for before, after in itertools.pairwise(sent))


def lose_tilt(run: SampledRun) -> None:
    run.at(GONE_NS / 1e6, run.servos["tilt"].silence)
    run.at(BACK_NS / 1e6, lambda: run.servos["tilt"].silence(False))


HELD = ["is held until all its joints answer again", "resumes: all its joints answer again"]


def test_controllers_of_a_lost_servo_are_held_then_go_on_slowly_and_the_others_are_as_before(built, acts):
    acts |= {"pair": sway, "single": sway}
    run = built()
    lose_tilt(run)
    log = run.run()
    lost_ns, slow_ns = GONE_NS + 4 * PERIOD_NS, BACK_NS + 900_000_000
    assert swing(goals(run, "pan", lost_ns, BACK_NS)) == 0
    assert goals(run, "tilt", lost_ns, BACK_NS) == []
    assert swing(goals(run, "yaw", lost_ns, BACK_NS)) > 0.5
    assert texts(log, EventCode.POLICY) == HELD
    assert swing(goals(run, "pan", BACK_NS + 500_000_000)) > 0.5
    assert largest_step(goals(run, "pan", BACK_NS, slow_ns)) <= 1.5 * 0.02 + TICK
    for begin_ns, end_ns in ((lost_ns, BACK_NS), (BACK_NS, slow_ns)):
        assert largest_step(goals(run, "yaw", begin_ns, end_ns)) > 1.5 * 0.02 + TICK, "yaw was slowed down"


def test_a_command_does_not_wake_a_controller_whose_servo_is_lost(built):
    run = built(1.2)
    lose_tilt(run)
    first = run.ask(400, send("pair", "positions", 0.0, 0.0))
    run.ask(700, send("pair", "positions", 0.5, 0.5))
    run.run()
    assert run.is_done(first)
    assert swing(goals(run, "pan", GONE_NS, BACK_NS)) == 0


def test_a_controller_that_is_activated_while_its_servo_is_lost_waits_for_it_too(built, acts):
    acts |= {"calm": sway}
    run = built()
    lose_tilt(run)
    run.ask(700, switch(["calm"], ["pair"]))
    run.run()
    assert run.is_done()
    assert swing(goals(run, "pan", GONE_NS, BACK_NS)) == 0
    assert swing(goals(run, "pan", BACK_NS)) > 0.5


def test_no_controller_takes_over_from_one_that_fails_while_it_leaves(built, monkeypatch):
    def leave(controller, time_ns):
        raise ValueError("not like this")

    monkeypatch.setattr(JointGroupPositionController, "on_deactivate", leave)
    robot = built(0.2).robot
    assert robot.run().reason == "fault"
    assert robot.robot.manager.active == ()


def test_a_servo_that_flickers_holds_and_frees_its_controllers_each_time_and_moves_slowly(built, acts):
    acts |= {"pair": sway, "single": sway}
    run = built()
    servo = run.servos["tilt"]
    for ms in range(500, 2100, 400):  # five replies are lost, then it is looked at, and a few come
        run.at(ms, servo.silence)
        run.at(ms + 100, lambda: servo.silence(False))
    assert texts(run.run(), EventCode.POLICY) == HELD * 4
    sent = goals(run, "pan", GONE_NS + 100_000_000, GONE_NS + 1_600_000_000)
    assert 0.02 < largest_step(sent) < 0.03 + TICK  # one a cycle, however late it is sent


def test_a_pose_at_the_end_does_not_wait_for_a_servo_that_is_lost(built):
    more = "poses: {home: {pan: 20 deg, tilt: 20 deg, yaw: 20 deg}}\n"
    more += "policies: {on_exit: [{pose: home, speed: 60 deg/s}, limp], exit_timeout: 8 s}\n"
    run = built(more=more)
    run.at(GONE_NS / 1e6, run.servos["tilt"].silence)
    run.at(BACK_NS / 1e6, run.robot.stop.request)
    run.run("stopped")
    assert run.robot.result is not None
    assert run.robot.result.last == "limp"
    assert run.robot.clock.now_ns() < BACK_NS + 1_500_000_000, "it waited for the lost one"
    ended = round(math.radians(170) / TICK) * TICK
    assert [goals(run, joint)[-1] for joint in ("pan", "yaw")] == pytest.approx([ended, ended])


def test_all_joints_of_a_group_lose_their_torque_with_one_of_its_servos(built):
    run = built(1.5, "policies: {groups: {neck: {joints: [pan, tilt], on_lost_servo: limp}}}\n")
    had = []
    run.at(GONE_NS / 1e6, run.servos["tilt"].silence)
    for ms in (GONE_NS / 1e6, GONE_NS / 1e6 + 500):
        run.at(ms, lambda: had.extend(run.servos[joint].torque_on for joint in ("pan", "yaw")))
    log = run.run()
    assert had == [True, True, False, True]
    (said,) = [event.text for event in log.events if "group" in event.text]
    assert said == "group neck lost a servo: the group is limp until a client requests torque"


def test_the_first_reason_to_end_a_run_decides_by_which_policy(built):
    run = built(
        1.5,
        "policies: {on_lost_servo: [{reduce_torque: 0.5, steps: 2, over: 100 ms}, hold], on_fault: limp,"
        " groups: {neck: {joints: [tilt], on_lost_servo: stop}}}\n",
    )
    for joint in ("pan", "tilt"):
        run.at(GONE_NS / 1e6, run.servos[joint].silence)
    result = run.robot.run()
    assert (result.reason, result.last) == ("fault", "hold")
    assert result.detail.startswith("pan missed at least 3 replies in a row; on_lost_servo: ")
    assert run.servos["yaw"].torque_on


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
