"""leader_follower: softly into step, then at once; holds when its leader falls silent."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.stages import standing

from dxlrun.channels.cycle import Torque
from dxlrun_controllers.leader_follower import LeaderFollower

PAIR = {"pairs": [{"joint": "f", "leader": "l"}], "speed": "1 rad/s"}
TWO = {
    "pairs": [
        {"joint": "f", "leader": "l", "scale": -0.5, "offset": "0.2 rad"},
        {"joint": "g", "leader": "m"},
    ]
}
STREAM = {"pairs": [{"joint": "f"}, {"joint": "g"}], "speed": "1 rad/s"}


def lead(robot, *positions, velocity=0.0, age=0.0):
    count = len(positions)
    robot.context.reads[:] = [*positions, *[velocity] * count, *[age] * count]


def test_it_starts_at_its_speed_and_is_then_in_step_at_once():
    robot = standing(LeaderFollower, PAIR).activate()
    lead(robot, 0.5)
    path = []
    for _ in range(40):
        robot.step()
        path.append(robot.commands.position[0])
    np.testing.assert_allclose(path, np.minimum(0.02 * np.arange(1, 41), 0.5))
    lead(robot, 1.4)  # 45 rad/s: in step it follows, and the last gate limits
    robot.step()
    assert robot.commands.position[0] == 1.4


@settings(max_examples=50, deadline=None)
@given(path=st.lists(st.floats(-3, 3), min_size=2, max_size=60))
def test_in_step_a_command_is_made_of_the_state_of_its_own_cycle(path):
    robot = standing(LeaderFollower, TWO).activate()
    lead(robot, 0.4, 0.0)
    robot.step()
    for position in path:
        lead(robot, position, 0.1)
        robot.step()
        if robot.controller._in_step.all():
            np.testing.assert_allclose(robot.commands.position, [-0.5 * position + 0.2, 0.1])


def test_a_follower_that_had_not_answered_starts_softly_where_it_is_heard():
    robot = standing(LeaderFollower, {"pairs": [{"joint": "a", "leader": "b"}], "speed": "1 rad/s"})
    robot.states.position[:] = np.nan
    robot.activate()
    robot.context.reads[:] = 1.0, 0.0, 0.0
    robot.step()
    assert np.isnan(robot.commands.position[0])
    robot.states.position[:] = 0.5
    for n in range(1, 4):
        robot.step()
        assert robot.commands.position[0] == pytest.approx(0.5 + 0.02 * n)


def test_limits_of_the_followers_hold():
    robot = standing(LeaderFollower, PAIR, limits={"lower": -0.1, "upper": 0.1}).activate()
    for leader, follower in ((3.0, 0.1), (-3.0, -0.1)):
        lead(robot, leader)
        robot.steps(20)
        assert robot.commands.position[0] == follower


@pytest.mark.parametrize("silence", [0.11, np.nan, np.inf])
def test_a_silent_leader_is_reported_once_and_all_hold_until_it_is_back(silence):
    robot = standing(LeaderFollower, TWO | {"speed": "1 rad/s"}).activate()
    lead(robot, 0.4, 0.0)
    robot.step()
    held = robot.commands.position.copy()
    lead(robot, 2.0, 1.0)
    robot.context.reads[5] = silence
    for _ in range(10):
        robot.step()
        np.testing.assert_array_equal(robot.commands.position, held)
    (sentence,) = robot.said
    assert sentence.startswith("no reply from leader m")
    assert sentence.endswith("holding")
    lead(robot, 0.4, 1.0)
    robot.step()  # softly again
    np.testing.assert_allclose(robot.commands.position, [0.0, held[1] + 0.02], atol=1e-12)
    robot.context.reads[4] = 0.3
    robot.step()
    assert robot.said[1] == "no reply from leader l for 0.30 s, holding"


def test_after_a_lost_joint_is_back_it_starts_softly_from_what_was_sent():
    robot = standing(LeaderFollower, PAIR).activate()
    lead(robot, 0.0)
    robot.step()
    lead(robot, 1.0)
    robot.states.torque[0] = Torque.LOST
    for _ in range(50):
        robot.sent.position[:] = 0.3  # a returned servo was brought elsewhere
        robot.step()
    robot.states.torque[0] = Torque.ON
    robot.step()
    assert robot.commands.position[0] == pytest.approx(0.3 + 2 * 0.02)


def test_positions_are_followed_as_long_as_they_come():
    robot = standing(LeaderFollower, STREAM).activate()
    robot.step()
    assert robot.commands.position.tolist() == [0.0, 0.0]
    assert robot.said == []
    for _ in range(10):
        robot.give("positions", positions=[0.1, -0.1])
        robot.step()
    np.testing.assert_allclose(robot.commands.position, [0.1, -0.1])
    robot.steps(10)
    assert robot.said == ["no positions for 0.12 s, holding"]
    robot.give("positions", positions=[0.2, -0.2])
    robot.step()
    np.testing.assert_allclose(robot.commands.position, [0.12, -0.12])


def test_posvel_commands_the_leaders_speed_as_a_magnitude_or_as_a_reference():
    for into, expected in (((), 0.8), (("pid",), -0.8)):
        robot = standing(LeaderFollower, PAIR | {"command_interface": "posvel"}, into=into).activate()
        lead(robot, -0.5, velocity=-0.8)
        robot.step()
        assert robot.commands.velocity[0] == (-1.0 if into else 1.0)  # on the way there
        robot.steps(30)
        assert robot.commands.velocity[0] == expected
        lead(robot, -0.5, age=1.0)
        robot.step()
        assert robot.commands.velocity[0] == (0.0 if into else 0.5)


def test_a_live_speed_counts_at_once():
    robot = standing(LeaderFollower, PAIR).activate()
    lead(robot, 2.0)
    robot.step()
    robot.controller.parameters = robot.model.model_copy(update={"speed": 2.0})
    robot.step()
    assert robot.commands.position[0] == pytest.approx(0.06)
