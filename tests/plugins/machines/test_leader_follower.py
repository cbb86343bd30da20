"""leader_follower: no cycle later than its leader; single cases are in `scripts/leader.txt`."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.stages import standing

from dxlrun_controllers.leader_follower import LeaderFollower

TWO = {
    "pairs": [
        {"joint": "f", "leader": "l", "scale": -0.5, "offset": "0.2 rad"},
        {"joint": "g", "leader": "m"},
    ]
}


@settings(max_examples=50, deadline=None)
@given(path=st.lists(st.floats(-3, 3), min_size=2, max_size=60))
def test_in_step_a_command_is_made_of_the_state_of_its_own_cycle(path):
    robot = standing(LeaderFollower, TWO).activate()
    followed = 0
    for position in [0.4, *path]:
        robot.context.reads[:] = position, 0.1, 0.0, 0.0, 0.0, 0.0
        robot.step()
        if robot.controller._in_step.all():
            np.testing.assert_allclose(robot.commands.position, [-0.5 * position + 0.2, 0.1])
            followed += 1
    assert followed >= len(path) - 5
