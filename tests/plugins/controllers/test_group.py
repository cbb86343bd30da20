"""Group controllers and the broadcaster: hold first, then forward what was sent."""

import numpy as np
import pytest
from tests.kit.stages import Stage

from dxlrun_controllers.group import (
    JointGroupEffortController,
    JointGroupPosEffortController,
    JointGroupPositionController,
    JointGroupPosVelController,
    JointGroupPwmController,
    JointGroupVelocityController,
)
from dxlrun_controllers.joint_state_broadcaster import JointStateBroadcaster

TWO = {"joints": ["a", "b"]}


DRIVES = [
    (JointGroupVelocityController, "velocity", "velocities", "velocities"),
    (JointGroupEffortController, "effort", "efforts", "efforts"),
    (JointGroupPwmController, "pwm", "pwm", "pwm"),
]


@pytest.mark.parametrize(("group", "claimed", "kind", "field"), DRIVES)
def test_drives_are_zero_until_a_command_comes_and_forward_it(group, claimed, kind, field):
    robot = Stage(group, TWO)
    robot.activate()
    commands = robot.commands
    assert getattr(commands, claimed).tolist() == [0.0, 0.0]
    robot.send(0.0, kind, **{field: [0.5, -0.25]})
    for time in (0.0, 0.02):
        robot.update(time, follow=False)
        assert getattr(commands, claimed).tolist() == [0.5, -0.25]
    assert np.isnan(commands.position).all()


def test_positions_and_efforts_are_forwarded_together():
    robot = Stage(JointGroupPosEffortController, TWO)
    robot.activate()
    np.testing.assert_array_equal(robot.update(0.0), [0.3, -0.2])
    assert np.isnan(robot.commands.effort).all()
    robot.send(0.0, "poseffort", positions=[0.5, 0.6], efforts=[0.1, 0.2])
    np.testing.assert_array_equal(robot.update(0.0), [0.5, 0.6])
    np.testing.assert_array_equal(robot.commands.effort, [0.1, 0.2])


@pytest.mark.parametrize(
    "group", [JointGroupPositionController, JointGroupPosVelController, JointGroupPosEffortController]
)
def test_they_start_by_holding_the_present_goal_and_never_drive_to_zero(group):
    robot = Stage(group, TWO)
    robot.states.position[:] = 0.31, -0.19
    robot.activate()
    np.testing.assert_array_equal(robot.update(0.0), [0.3, -0.2])
    assert np.isnan(robot.commands.velocity).all()


def test_where_nothing_was_sent_yet_the_present_position_is_held():
    robot = Stage(JointGroupPositionController, TWO)
    robot.sent.position[1] = np.nan
    robot.activate()
    np.testing.assert_array_equal(robot.update(0.0), [0.3, -0.2])


def test_positions_are_forwarded_until_the_next_ones():
    robot = Stage(JointGroupPositionController, TWO).activate()
    robot.send(0.0, "positions", positions=[0.5, 0.6])
    for time in (0.0, 0.02, 0.04):
        np.testing.assert_array_equal(robot.update(time), [0.5, 0.6])
    robot.send(0.06, "positions", positions=[0.1, 0.2])
    np.testing.assert_array_equal(robot.update(0.06), [0.1, 0.2])


def test_positions_and_velocities_are_forwarded_together():
    robot = Stage(JointGroupPosVelController, TWO).activate()
    robot.send(0.0, "posvel", positions=[0.5, 0.6], velocities=[1.0, -2.0])
    np.testing.assert_array_equal(robot.update(0.0), [0.5, 0.6])
    np.testing.assert_array_equal(robot.commands.velocity, [1.0, -2.0])


def test_the_broadcaster_publishes_each_update():
    robot = Stage(JointStateBroadcaster, {})
    assert JointStateBroadcaster.publishes == ("/joint_states",)
    robot.activate()
    for time in range(3):
        robot.update(time)
    assert len(robot.messages) == 3
    assert np.isnan(robot.commands.position).all()


def test_into_another_controller_a_servos_speed_is_no_velocity():
    """Beside a servo's position it is a magnitude: as a reference, the joint would be sent on by it."""
    for into, expected in (((), [0.5, 0.5]), (("lower",), [np.nan, np.nan])):
        robot = Stage(JointGroupPosVelController, TWO, into=into)
        robot.sent.velocity[:] = 0.5
        robot.activate()
        np.testing.assert_array_equal(robot.commands.velocity, expected)
