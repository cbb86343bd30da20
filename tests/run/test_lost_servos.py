"""When a joint is lost, and what the monitor of lost servos does; whole runs: stories/lost_servos.txt."""

from unittest.mock import Mock

import pytest

from dxlrun.channels.cycle import States
from dxlrun.features.lost_servos import GroupPolicy, LostServos, MissedReplies
from dxlrun.plan.policy_plan import PolicyPlan

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


@pytest.mark.parametrize(("own", "count"), [("limp", 1), ("hold", 0)])
def test_group_becomes_limp_once_or_holds_however_many_servos_it_loses(own, count):
    states, actions = States.empty(2), Mock(policies=PolicyPlan())
    monitor = LostServos(("a", "b"), states, actions, (GroupPolicy("arm", frozenset({0, 1}), own),))
    states.age_ns[:] = 100_000_000
    for lost in [0] * 5 + [1] * 5:
        states.valid[:] = True
        states.valid[lost] = False
        monitor.check_cycle(0)
    assert actions.make_limp.call_count == count
