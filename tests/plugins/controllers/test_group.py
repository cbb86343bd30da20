"""Group controllers and the broadcaster: hold first, then forward what was sent."""

import numpy as np
import pytest
from tests.kit.laws import cases
from tests.kit.stages import Stage

from dxlrun_controllers.joint_state_broadcaster import JointStateBroadcaster

GROUPS = [case for case in cases(("a", "b")) if case.type.startswith("joint_group_")]
FIELDS = {"position": "positions", "velocity": "velocities", "effort": "efforts", "pwm": "pwm"}


@pytest.mark.parametrize("case", [pytest.param(case, id=case.type) for case in GROUPS])
def test_it_holds_or_gives_nothing_until_a_command_comes_and_forwards_it(case):
    robot = case.stage(present=(0.31, -0.19))
    robot.sent.position[:] = 0.3, np.nan  # where nothing was sent yet, the present position is held
    claimed = robot.interfaces.command
    held = {"position": [0.3, -0.19]} if "position" in claimed else {claimed[0]: [0.0, 0.0]}
    (kind,) = robot.type.Commands
    robot.activate()
    for values in ({}, {name: [0.5, -0.25] for name in claimed}, {name: [0.1, 0.2] for name in claimed}):
        if values:
            robot.send(0.0, kind, **{FIELDS[name]: numbers for name, numbers in values.items()})
        for time in (0.0, 0.02):
            robot.update(time, follow=False)
            for name in FIELDS:
                expected = (values or held).get(name, [np.nan, np.nan])
                np.testing.assert_array_equal(getattr(robot.commands, name), expected)


def test_the_broadcaster_publishes_each_update():
    robot = Stage(JointStateBroadcaster, {}).activate()
    assert JointStateBroadcaster.publishes == ("/joint_states",)
    for time in range(3):
        robot.update(time)
    assert len(robot.messages) == 3
    assert np.isnan(robot.commands.position).all()
