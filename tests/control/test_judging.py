"""Goals of several joints: each joint counts by its own tolerance, and only joints of the goal count."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from dxlrun.channels.cycle import CycleLayout, CycleRecord, Torque
from dxlrun.channels.event_records import EventBody
from dxlrun.contract.controller import GoalTolerances, Outcome
from dxlrun.control.controllers.goal_registry import CurrentCommands, GoalRegistry, RunningGoal
from dxlrun.plan.loop_plan import JointPlan

PERIOD_NS = 20_000_000
NAN = np.nan


@dataclass
class Judged:
    """Two joints at 0 rad, and the judge of their goals, cycle by cycle."""

    settle_ns: tuple[int, int] = (1_000_000_000, 1_000_000_000)
    commands: CurrentCommands = field(default_factory=lambda: CurrentCommands(("a", "b")))
    events: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        plans = tuple(
            JointPlan(name, -3.0, 3.0, None, settle_ns=settle_ns)
            for name, settle_ns in zip(("a", "b"), self.settle_ns, strict=True)
        )
        self.record = CycleRecord(CycleLayout(("a", "b"), ("arm",)))
        self.record.period_ns = PERIOD_NS
        self.states = self.record.states
        self.states.motion[:], self.states.valid[:], self.states.torque[:] = 0.0, True, Torque.ON
        self.goals = GoalRegistry(self.record, self, plans, lambda controller: self.commands)

    def emit_event(self, source: str, event: EventBody, data: bytes = b"") -> None:
        self.events.append(event.text)

    def accept(self) -> RunningGoal:
        return self.goals.accept_goal("arm", "move", "anna")

    def cycles(self, count: int) -> None:
        for _ in range(count):
            self.goals.time_ns += PERIOD_NS
            self.goals.judge_running()


@pytest.mark.parametrize(
    ("settle_s", "cycles", "state", "row", "wrong"),
    [
        ((2.0, 0.1), 50, "position", 0, 0.5),  # the joint that may settle longest
        ((0.1, 2.0), 50, "position", 1, 0.5),
        ((1.0, 1.0), 1, "velocity", 1, 0.5),
        ((1.0, 1.0), 1, "velocity", 1, -0.5),
        ((0.0, 0.0), 1, "valid", 1, False),  # a lost reply, also without settling time
    ],
)
def test_a_goal_waits_until_its_joints_are_there_at_rest_and_heard(settle_s, cycles, state, row, wrong):
    judged = Judged(tuple(round(each * 1e9) for each in settle_s))
    goal, values = judged.accept(), getattr(judged.states, state)
    right, values[row] = values[row], wrong
    goal.judge(np.zeros(2))
    judged.cycles(cycles)
    assert goal.outcome is None
    values[row] = right
    judged.cycles(1)
    assert goal.outcome is Outcome.REACHED


@pytest.mark.parametrize(("tolerances", "outcome"), [((0.01, 0.5), "reached"), ((0.5, 0.01), "missed")])
def test_a_joint_is_judged_by_its_own_tolerance_where_the_goal_moves_it_alone(tolerances, outcome):
    judged = Judged()
    goal = judged.accept()
    judged.states.position[:] = 2.0, 0.1
    within = GoalTolerances(np.array(tolerances), np.full(2, NAN), 0)
    goal.judge(np.zeros(2), joints=["b"], tolerances=within)
    assert (goal.outcome, goal.joint) == (outcome, "b")


def test_a_goal_does_not_settle_longer_than_its_timeout():
    judged = Judged()
    goal = judged.accept()
    judged.states.position[:] = 0.5
    defaults = np.full(2, NAN)
    goal.judge(np.zeros(2), tolerances=GoalTolerances(defaults, defaults, left_ns=2 * PERIOD_NS))
    judged.cycles(1)
    assert goal.outcome is None
    judged.cycles(1)
    assert goal.outcome is Outcome.MISSED


LIMP = "goal 1 aborted: joint b is limp: its torque was switched off; too slow"


@pytest.mark.parametrize(
    ("joints", "said", "outcome", "text"),
    [
        (["a"], "too slow", "missed", "goal 1 missed: too slow"),
        (["a"], "", "missed", "goal 1 missed: joint a is 11.46 deg off"),
        (["a", "b"], "too slow", "aborted", LIMP),
        (None, "too slow", "aborted", LIMP),
    ],
)
def test_a_limp_joint_aborts_only_the_missed_goals_that_move_it(joints, said, outcome, text):
    judged = Judged()
    goal = judged.accept()
    judged.states.torque[1] = Torque.RELEASED
    goal.end(Outcome.MISSED, said, "a", 0.2, joints)
    assert (goal.outcome, judged.events[-1]) == (outcome, text)


@pytest.mark.parametrize(("commanded", "outcome"), [(0.0, "reached"), (0.03, "missed")])
def test_a_joint_with_a_velocity_command_is_not_at_rest(commanded, outcome):
    judged = Judged(commands=CurrentCommands(("a", "b"), velocities=np.array([0.0, commanded])))
    goal = judged.accept()
    goal.judge(np.full(2, NAN))
    judged.cycles(60)
    assert goal.outcome == outcome
    assert ("b ends with a commanded velocity of 1.72 deg/s" in goal.text) == (commanded > 0)
