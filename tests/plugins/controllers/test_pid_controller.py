"""pid_controller: its live gains and its state; what it commands is in `scripts/pid.txt`."""

import numpy as np
import pytest
from tests.kit.stages import Stage

from dxlrun.control.controllers.live_parameters import live_names, value_of, with_values
from dxlrun_controllers.pid_controller import PidController
from dxlrun_controllers.plugin import dxlrun_controllers

TWO = {"joints": ["a", "b"]}


def test_it_is_the_joint_position_controller_too():
    assert dxlrun_controllers()["joint_position_controller"] == dxlrun_controllers()["pid_controller"]


def test_gains_are_live_each_by_its_name_and_those_of_a_mapping_by_joint():
    model = PidController.Parameters.model_validate(TWO | {"gains": {"p": {"a": 1.0, "b": 2.0}, "i": 0.5}})
    assert list(live_names(model)) == [f"gains.{name}" for name in ("p.a", "p.b", "i", "d", "feed_forward")]
    changed = with_values(model, {"gains.p.b": 3.0, "gains.i": 0.0})
    assert (changed.gains.p, changed.gains.i) == ({"a": 1.0, "b": 3.0}, 0.0)
    assert model.gains.p == {"a": 1.0, "b": 2.0}
    assert value_of(changed, "gains.p.b") == 3.0
    for unknown in ("gains.p", "gains.p.c", "gains.i.a", "output_limit"):
        with pytest.raises(ValueError, match="is not a live parameter"):
            with_values(model, {unknown: 1.0})


def test_its_state_is_published_fifty_times_a_second():
    robot = Stage(PidController, TWO | {"gains": {"p": 2.0, "i": 1.0}}).activate()
    robot.give("positions", positions=[0.5, 0.0])
    for step in range(200):
        robot.controller.update(step * 5_000_000, 5_000_000)
    assert len(robot.messages) == 50
    topic, state = robot.messages[-1]
    assert topic == "state"
    parts = state.proportional + state.integral + state.derivative + state.feed_forward
    np.testing.assert_allclose(parts, state.output)
    np.testing.assert_allclose(state.output, robot.commands.effort)
    np.testing.assert_allclose(state.reference - state.measurement, state.error)
    np.testing.assert_allclose(state.error, [0.2, 0.2])
