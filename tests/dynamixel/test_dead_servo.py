"""One dead servo of eight costs the others less than 5 % of their rate, on lines that never rest."""

import math

import pytest
from tests.kit.rigs import make_plan, make_x, start_rig

SECONDS = 1.5


def states_in(rig, rows):
    """Return how many valid states joints got in some seconds of cycles without a gap between them."""
    end_ns = rig.clock.now_ns() + round(SECONDS * 1e9)
    count = 0
    while rig.clock.now_ns() < end_ns:
        rig.goals.position[:] += 1e-3 * math.sin(rig.clock.now_ns() * 1e-9)
        rig.hardware.read()
        count += int(rig.states.valid[rows].sum())
        rig.hardware.write()
        # what the goals take on the wire, and a little for controllers
        deadline = rig.clock.now_ns() + rig.plans[0].budget.goals_ns + 100_000
        rig.hardware.idle(deadline)
        rig.clock.wait_until(max(deadline, rig.clock.now_ns()))
    return count


@pytest.mark.parametrize(
    "plan",
    [make_plan(), make_x(fast=True), make_x()],
    ids=["AX one by one", "X fast sync read", "X sync read"],
)
def test_a_dead_servo_costs_the_others_less_than_a_twentieth(plan):
    rig = start_rig(plan)
    others = list(range(1, 8))  # the first one is the worst to lose: a chain ends there
    before = states_in(rig, others)
    rig.servo(rig.plans[0].servos[0].servo_id).silence()
    after = states_in(rig, others)
    assert after > 0.95 * before
