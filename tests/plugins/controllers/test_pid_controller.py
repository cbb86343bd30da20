"""pid_controller: references, set-points, holding, limits and gains that change in a run."""

from typing import Annotated

import numpy as np
import pytest
from pydantic import ValidationError
from tests.kit.stages import Stage

from dxlrun import LIVE, ParametersModel
from dxlrun.control.controllers.live_parameters import live_mistake, live_names, value_of, with_values
from dxlrun_controllers.pid_controller import PidController
from dxlrun_controllers.plugin import dxlrun_controllers

TWO = {"joints": ["a", "b"], "gains": {"p": 2.0}}
PERIOD = 0.02


def started(**more):
    options = {key: more.pop(key) for key in ("limits", "into", "present") if key in more}
    robot = Stage(PidController, TWO | more, **options)
    robot.states.velocity[:] = 0.0
    robot.activate()
    return robot


def commanded(robot, interface="effort"):
    robot.controller.update(0, round(PERIOD * 1e9))
    return getattr(robot.commands, interface).copy()


@pytest.mark.parametrize(
    ("more", "command", "reference"),
    [
        ({}, "effort", ("position", "velocity", "effort")),
        ({"command_interface": "velocity"}, "velocity", ("position", "velocity")),
        ({"command_interface": "position"}, "position", ("position", "velocity")),
        ({"command_interface": "pwm", "reference": "velocity"}, "pwm", ("velocity", "pwm")),
        ({"reference": "velocity"}, "effort", ("velocity", "effort")),
    ],
)
def test_what_it_claims_and_exports(more, command, reference):
    parameters = PidController.Parameters.model_validate(TWO | more)
    found = PidController.interfaces(parameters, ("a", "b", "c"))
    assert (found.joints, found.command, found.reference) == (("a", "b"), (command,), reference)


def test_it_is_the_joint_position_controller_too():
    assert dxlrun_controllers()["joint_position_controller"] == dxlrun_controllers()["pid_controller"]


def test_without_a_reference_it_holds_where_the_joints_were():
    robot = started()
    np.testing.assert_array_equal(commanded(robot), [0.0, 0.0])
    robot.states.position[:] = 0.2, -0.1
    np.testing.assert_allclose(commanded(robot), [2 * 0.1, 2 * -0.1])


def test_a_command_sets_the_positions_and_a_reference_goes_before_it():
    robot = started()
    robot.send(0.0, "positions", positions=[0.5, 0.0])
    np.testing.assert_allclose(commanded(robot), [2 * 0.2, 2 * 0.2])
    robot.context.references.position[:] = 0.4, np.nan
    np.testing.assert_allclose(commanded(robot), [2 * 0.1, 2 * 0.2])


def test_when_the_reference_ends_it_holds_where_the_joints_are_then():
    robot = started()
    robot.context.references.position[:] = 1.3, 0.8
    np.testing.assert_allclose(commanded(robot), [2.0, 2.0])
    robot.states.position[:] = 0.9, 0.1
    robot.context.references.position[0] = np.nan
    np.testing.assert_allclose(commanded(robot), [0.0, 2 * 0.7])
    robot.states.position[:] = 1.0, 0.1
    np.testing.assert_allclose(commanded(robot), [2 * -0.1, 2 * 0.7])


def test_a_reference_that_ends_while_the_joint_is_silent_is_held_where_it_is_heard_again():
    robot = started()
    robot.context.references.position[:] = 1.3, 0.8
    before = commanded(robot)
    robot.context.references.position[0] = np.nan
    robot.states.valid[0] = False
    np.testing.assert_array_equal(commanded(robot), before)
    robot.states.valid[0] = True
    robot.states.position[0] = 0.7
    np.testing.assert_allclose(commanded(robot), [0.0, 2.0])


def test_the_derivative_is_of_the_error_and_a_step_in_the_reference_makes_no_kick():
    robot = started(gains={"d": 0.5})
    robot.context.references.position[:] = 1.3, 0.8
    np.testing.assert_array_equal(commanded(robot), [0.0, 0.0])
    robot.states.velocity[:] = 0.4, -0.2
    np.testing.assert_allclose(commanded(robot), [-0.2, 0.1])
    robot.context.references.velocity[:] = 0.4, np.nan
    np.testing.assert_allclose(commanded(robot), [0.0, 0.1])


def test_an_effort_reference_and_the_velocitys_share_are_added():
    robot = started(gains={"p": 2.0, "feed_forward": {"a": 0.1}})
    robot.context.references.position[:] = 0.3, -0.2
    robot.context.references.velocity[:] = 3.0, 3.0
    robot.context.references.effort[:] = np.nan, 0.7
    np.testing.assert_allclose(commanded(robot), [0.3, 0.7])


def test_velocities_are_fed_forward_by_themselves():
    robot = started(command_interface="velocity")
    robot.context.references.position[:] = 0.4, -0.2
    robot.context.references.velocity[:] = 1.0, -1.5
    np.testing.assert_allclose(commanded(robot, "velocity"), [0.2 + 1.0, -1.5])


def test_a_velocity_reference_is_followed_and_is_zero_where_there_is_none():
    robot = started(reference="velocity", gains={"p": 1.0, "i": 10.0, "d": 0.1})
    robot.send(0.0, "velocities", velocities=[1.0, 0.0])
    np.testing.assert_allclose(commanded(robot), [1.0 + 10 * PERIOD, 0.0])
    robot.states.velocity[:] = 0.5, 0.0  # the rate is 25 rad/s^2, against it
    np.testing.assert_allclose(commanded(robot), [0.5 + 15 * PERIOD - 2.5, 0.0])
    robot.context.references.velocity[:] = 0.5, 2.0
    np.testing.assert_allclose(commanded(robot), [15 * PERIOD, 2.0 + 20 * PERIOD])
    robot.context.references.velocity[:] = np.nan
    integral = np.array([15 * PERIOD - 5 * PERIOD, 20 * PERIOD])
    np.testing.assert_allclose(commanded(robot), integral - [0.5, 0.0])


def test_a_position_command_corrects_what_the_servo_leaves_and_stays_in_the_limits():
    limits = {"lower": -0.5, "upper": 0.5}
    robot = started(command_interface="position", gains={"i": 10.0}, limits=limits)
    np.testing.assert_allclose(commanded(robot, "position"), [0.3, -0.2])
    robot.send(0.0, "positions", positions=[0.45, -0.2])
    for _ in range(100):
        found = commanded(robot, "position")
    np.testing.assert_allclose(found, [0.5, -0.2])
    robot.states.position[0] = 0.47
    assert commanded(robot, "position")[0] < 0.5  # it did not wind up


def test_activated_again_it_has_forgotten_its_reference_and_its_slope():
    robot = started(reference="velocity", gains={"d": 1.0})
    robot.context.references.velocity[:] = 1.0
    robot.states.velocity[:] = 0.5
    commanded(robot)
    robot.context.references.velocity[:] = np.nan
    robot.activate()
    robot.send(0.0, "velocities", velocities=[0.5, 0.5])
    robot.states.velocity[:] = 3.0
    np.testing.assert_array_equal(commanded(robot), 0.0)  # no rate of a velocity of long ago
    robot.controller.parameters = robot.controller.parameters.model_copy(
        update={"gains": robot.controller.parameters.gains.model_copy(update={"p": 1.0})}
    )
    robot.controller.on_parameters(0)
    np.testing.assert_array_equal(commanded(robot), -2.5)  # the command stands: no reference has ended


def test_a_lost_reply_keeps_the_correction_and_not_the_reference():
    robot = started(command_interface="position", gains={"p": 0.5})
    references, states = robot.context.references, robot.states
    references.position[:] = 1.0
    np.testing.assert_allclose(commanded(robot, "position"), [1.0 + 0.5 * 0.7, 1.0 + 0.5 * 1.2])
    states.valid[0], references.position[:] = False, 1.2
    states.position[0] = np.nan
    assert commanded(robot, "position")[0] == pytest.approx(1.2 + 0.5 * 0.7)
    references.position[:] = np.nan  # ended, and where the joint is then is not known
    assert commanded(robot, "position")[0] == pytest.approx(1.2 + 0.5 * 0.7)


def test_a_correction_that_was_there_before_goes_on():
    robot = Stage(PidController, TWO | {"command_interface": "position", "gains": {"i": 1.0}})
    robot.states.velocity[:] = 0.0
    robot.states.position[:] = 0.28, -0.21  # the load pulls them off their goals 0.3 and -0.2
    robot.activate()
    np.testing.assert_allclose(commanded(robot, "position"), [0.3, -0.2])


def test_an_effort_that_is_exerted_goes_on_at_the_activation():
    robot = Stage(PidController, TWO | {"gains": {"p": 2.0, "i": 1.0}})
    robot.states.velocity[:] = 0.0
    robot.sent.effort[:] = 0.4, np.nan
    robot.activate()
    np.testing.assert_allclose(commanded(robot), [0.4, 0.0])


@pytest.mark.parametrize(
    ("interface", "limits", "limit"),
    [("effort", {"effort": 0.8}, 0.8), ("velocity", {"velocity": 2.5}, 2.5), ("pwm", {}, 1.0)],
)
def test_the_output_ends_at_the_joints_limit(interface, limits, limit):
    robot = started(command_interface=interface, gains={"p": 100.0}, limits=limits)
    robot.send(0.0, "positions", positions=[2.0, -2.0])
    np.testing.assert_array_equal(commanded(robot, interface), [limit, -limit])


def test_a_limit_of_the_file_is_for_each_joint():
    robot = started(gains={"p": 100.0}, output_limit={"b": 0.2}, limits={"effort": 0.5})
    robot.send(0.0, "positions", positions=[2.0, -2.0])
    np.testing.assert_array_equal(commanded(robot), [0.5, -0.2])


def test_only_the_joints_that_wrap_go_the_shorter_way_round():
    robot = started(wrap=["a"], present=(3.0, 3.0))
    robot.send(0.0, "positions", positions=[-3.0, -3.0])
    np.testing.assert_allclose(commanded(robot), [2 * (2 * np.pi - 6.0), -12.0])


def test_gains_change_in_a_run_without_a_jump_of_the_integral():
    robot = started(gains={"p": 1.0, "i": 5.0})
    robot.send(0.0, "positions", positions=[0.4, -0.2])
    for _ in range(50):
        before = commanded(robot)
    robot.change(1.0, gains={"p": 1.0, "i": {"a": 10.0, "b": 0.0}})
    np.testing.assert_allclose(commanded(robot) - before, [10 * 0.1 * PERIOD, 0.0], atol=1e-12)
    robot.change(1.0, gains={"p": 1.0})
    np.testing.assert_allclose(commanded(robot), [0.1, 0.0])


@pytest.mark.parametrize("interface", ["effort", "velocity", "pwm"])
def test_a_joint_that_was_never_heard_gets_nothing_of_its_own(interface):
    robot = Stage(PidController, TWO | {"command_interface": interface})
    robot.states.velocity[:] = 0.0
    robot.states.position[0] = np.nan
    robot.states.valid[0] = False
    robot.activate()
    np.testing.assert_array_equal(commanded(robot, interface), [0.0, 0.0])
    robot.states.position[0] = 1.0
    robot.states.valid[0] = True
    np.testing.assert_array_equal(commanded(robot, interface), [0.0, 0.0])  # held where it was heard
    robot.states.position[0] = 0.9
    np.testing.assert_allclose(commanded(robot, interface), [0.2, 0.0])


def test_a_position_that_was_never_heard_is_not_commanded():
    robot = Stage(PidController, TWO | {"command_interface": "position"})
    robot.states.position[0] = np.nan
    robot.states.velocity[:] = 0.0
    robot.activate()
    np.testing.assert_array_equal(commanded(robot, "position"), [np.nan, -0.2])


@pytest.mark.parametrize(
    ("more", "kind", "sentence"),
    [
        ({}, "velocities", "its reference is the position, so it takes positions, not velocities"),
        ({"reference": "velocity"}, "positions", "so it takes velocities, not positions"),
    ],
)
def test_a_command_of_the_other_kind_is_refused(more, kind, sentence):
    with pytest.raises(ValueError, match=sentence):
        started(**more).prepare(kind, **{kind: [0.1, 0.2]})


def test_a_command_of_a_wrong_size_is_refused():
    with pytest.raises(ValueError, match=r"1 positions for 2 joints \(a, b\)"):
        started().prepare("positions", positions=[0.1])


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"gains": {"p": -1.0}}, "greater than or equal to 0"),
        ({"gains": {"p": {"c": 1.0}}}, r"gains.p names c, which is not one of its joints \(a, b\)"),
        ({"output_limit": {"c": 1.0}}, "output_limit names c"),
        ({"wrap": ["c"]}, "wrap names c"),
        ({"reference": "velocity", "wrap": ["a"]}, "velocities do not wrap"),
        ({"reference": "velocity", "command_interface": "position"}, "cannot be commanded as positions"),
        ({"gains": {"p": "3 Nm"}}, "valid number"),
    ],
)
def test_wrong_parameters_are_refused_in_words(wrong, sentence):
    with pytest.raises(ValidationError, match=sentence):
        PidController.Parameters.model_validate(TWO | wrong)


def test_parameters_survive_the_plan():
    written = TWO | {"gains": {"p": {"a": 1.0}, "d": 0.1}, "derivative_filter": "10 ms", "output_limit": 2.0}
    model = PidController.Parameters.model_validate(written)
    assert model.derivative_filter == 10_000_000
    assert PidController.Parameters.model_validate_json(model.model_dump_json()) == model


def test_gains_are_live_each_by_its_name_and_those_of_a_mapping_by_joint():
    model = PidController.Parameters.model_validate(TWO | {"gains": {"p": {"a": 1.0, "b": 2.0}, "i": 0.5}})
    assert list(live_names(model)) == [
        "gains.p.a",
        "gains.p.b",
        "gains.i",
        "gains.d",
        "gains.feed_forward",
    ]
    changed = with_values(model, {"gains.p.b": 3.0, "gains.i": 0.0})
    assert (changed.gains.p, changed.gains.i) == ({"a": 1.0, "b": 3.0}, 0.0)
    assert model.gains.p == {"a": 1.0, "b": 2.0}
    assert value_of(changed, "gains.p.b") == 3.0
    for unknown in ("gains.p", "gains.p.c", "gains.i.a", "output_limit"):
        with pytest.raises(ValueError, match="is no live parameter"):
            with_values(model, {unknown: 1.0})
    assert live_mistake(PidController.Parameters) == ""


class TextByJoint(ParametersModel):
    inner: Annotated[dict[str, str], LIVE]


def test_a_live_mapping_is_one_of_numbers():
    assert live_mistake(TextByJoint) == "inner"


def test_its_state_is_published_fifty_times_a_second():
    robot = started(gains={"p": 2.0, "i": 1.0})
    robot.send(0.0, "positions", positions=[0.5, 0.0])
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
