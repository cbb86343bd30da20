"""When a joint is lost, and what the monitor of lost servos does; whole runs: stories/lost_servos.txt."""

import pytest

from dxlrun.channels.cycle import States
from dxlrun.channels.event_records import EventBody
from dxlrun.features.lost_servos import GroupPolicy, LostServos, MissedReplies
from dxlrun.plan.policy_plan import LIMP, PolicyPlan

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
