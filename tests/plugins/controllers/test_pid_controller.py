"""pid_controller: references, set-points, holding, limits and gains that change in a run."""

import numpy as np
import pytest
from tests.kit.stages import Stage

from dxlrun.control.controllers.live_parameters import live_names, value_of, with_values
from dxlrun_controllers.pid_controller import PidController
from dxlrun_controllers.plugin import dxlrun_controllers

TWO = {"joints": ["a", "b"], "gains": {"p": 2.0}}
PERIOD = 0.02
POSITION = {"command_interface": "position"}
VELOCITY = {"reference": "velocity"}


class Law(Stage):
    """A pid_controller of joints at 0.3 and -0.2 rad; `commanded` is what it commands in the next cycle."""

    def __init__(self, limits=(), into=(), present=(0.3, -0.2), **more):
        super().__init__(PidController, TWO | more, limits=dict(limits), into=into, present=present)
        self.references = self.context.references
        self.interface = self.model.command_interface

    def sees(self, velocity=0.0, **references):
        """Let joints have a velocity, and references be commanded."""
        self.states.velocity[:] = velocity
        for name, value in references.items():
            getattr(self.references, name)[:] = value
        return self

    def commanded(self):
        self.controller.update(0, round(PERIOD * 1e9))
        return getattr(self.commands, self.interface).copy()

    def commands_are(self, *expected):
        np.testing.assert_allclose(self.commanded(), expected)


def started(**more):
    return Law(**more).activate()


def test_it_is_the_joint_position_controller_too():
    assert dxlrun_controllers()["joint_position_controller"] == dxlrun_controllers()["pid_controller"]


def test_without_a_reference_it_holds_where_the_joints_were():
    robot = started()
    robot.commands_are(0.0, 0.0)
    robot.states.position[:] = 0.2, -0.1
    robot.commands_are(2 * 0.1, 2 * -0.1)


def test_a_command_sets_the_positions_and_a_reference_goes_before_it():
    robot = started()
    robot.give("positions", positions=[0.5, 0.0])
    robot.commands_are(2 * 0.2, 2 * 0.2)
    robot.sees(position=[0.4, np.nan]).commands_are(2 * 0.1, 2 * 0.2)


def test_when_the_reference_ends_it_holds_where_the_joints_are_then():
    robot = started().sees(position=[1.3, 0.8])
    robot.commands_are(2.0, 2.0)
    robot.states.position[:] = 0.9, 0.1
    robot.sees(position=[np.nan, 0.8]).commands_are(0.0, 2 * 0.7)
    robot.states.position[:] = 1.0, 0.1
    robot.commands_are(2 * -0.1, 2 * 0.7)


def test_a_reference_that_ends_while_the_joint_is_silent_is_held_where_it_is_heard_again():
    robot = started().sees(position=[1.3, 0.8])
    before = robot.commanded()
    robot.states.valid[0] = False
    robot.sees(position=[np.nan, 0.8]).commands_are(*before)
    robot.states.valid[0], robot.states.position[0] = True, 0.7
    robot.commands_are(0.0, 2.0)


def test_the_derivative_is_of_the_error_and_a_step_in_the_reference_makes_no_kick():
    robot = started(gains={"d": 0.5}).sees(position=[1.3, 0.8])
    robot.commands_are(0.0, 0.0)
    robot.sees([0.4, -0.2]).commands_are(-0.2, 0.1)
    robot.references.velocity[:] = 0.4, np.nan
    robot.commands_are(0.0, 0.1)


@pytest.mark.parametrize(
    ("more", "references", "expected"),
    [
        # an effort reference and the velocity's share are added
        (
            {"gains": {"p": 2.0, "feed_forward": {"a": 0.1}}},
            {"position": [0.3, -0.2], "effort": [np.nan, 0.7]},
            [0.3, 0.7],
        ),
        # velocities are fed forward by themselves
        ({"command_interface": "velocity"}, {"position": [0.4, -0.2]}, [0.2 + 3.0, 3.0]),
    ],
)
def test_what_is_fed_forward(more, references, expected):
    robot = started(**more).sees(**references)
    robot.references.velocity[:] = 3.0
    robot.commands_are(*expected)


def test_a_velocity_reference_is_followed_and_is_zero_where_there_is_none():
    robot = started(**VELOCITY, gains={"p": 1.0, "i": 10.0, "d": 0.1})
    robot.give("velocities", velocities=[1.0, 0.0])
    robot.commands_are(1.0 + 10 * PERIOD, 0.0)
    robot.sees([0.5, 0.0]).commands_are(0.5 + 15 * PERIOD - 2.5, 0.0)  # the rate is 25 rad/s^2, against it
    robot.references.velocity[:] = 0.5, 2.0
    robot.commands_are(15 * PERIOD, 2.0 + 20 * PERIOD)
    robot.references.velocity[:] = np.nan
    robot.commands_are(15 * PERIOD - 5 * PERIOD - 0.5, 20 * PERIOD)


def test_a_position_command_corrects_what_the_servo_leaves_and_stays_in_the_limits():
    robot = started(**POSITION, gains={"i": 10.0}, limits={"lower": -0.5, "upper": 0.5})
    robot.commands_are(0.3, -0.2)
    robot.give("positions", positions=[0.45, -0.2])
    for _ in range(100):
        found = robot.commanded()
    np.testing.assert_allclose(found, [0.5, -0.2])
    robot.states.position[0] = 0.47
    assert robot.commanded()[0] < 0.5  # it did not wind up


def test_a_lost_reply_keeps_the_correction_and_not_the_reference():
    robot = started(**POSITION, gains={"p": 0.5}).sees(position=1.0)
    robot.commands_are(1.0 + 0.5 * 0.7, 1.0 + 0.5 * 1.2)
    robot.states.valid[0], robot.states.position[0] = False, np.nan
    # the second one: ended, and where the joint is then is not known
    for reference in (1.2, np.nan):
        assert robot.sees(position=reference).commanded()[0] == pytest.approx(1.2 + 0.5 * 0.7)


@pytest.mark.parametrize(
    ("more", "sent", "expected"),
    [
        # the load pulls them off their goals 0.3 and -0.2
        (POSITION | {"gains": {"i": 1.0}, "present": (0.28, -0.21)}, {"position": [0.3, -0.2]}, [0.3, -0.2]),
        ({"gains": {"p": 2.0, "i": 1.0}}, {"effort": [0.4, np.nan]}, [0.4, 0.0]),
    ],
    ids=["correction", "effort"],
)
def test_what_was_there_before_the_activation_goes_on(more, sent, expected):
    robot = Law(**more)
    for name, value in sent.items():
        getattr(robot.sent, name)[:] = value
    robot.activate().commands_are(*expected)


@pytest.mark.parametrize(
    ("more", "limit"),
    [
        ({"limits": {"effort": 0.8}}, [0.8, -0.8]),
        ({"command_interface": "velocity", "limits": {"velocity": 2.5}}, [2.5, -2.5]),
        ({"command_interface": "pwm"}, [1.0, -1.0]),
        ({"output_limit": {"b": 0.2}, "limits": {"effort": 0.5}}, [0.5, -0.2]),
    ],
)
def test_the_output_ends_at_the_limit_of_the_joint_and_of_the_file(more, limit):
    robot = started(gains={"p": 100.0}, **more)
    robot.give("positions", positions=[2.0, -2.0])
    robot.commands_are(*limit)


def test_only_the_joints_that_wrap_go_the_shorter_way_round():
    robot = started(wrap=["a"], present=(3.0, 3.0))
    robot.give("positions", positions=[-3.0, -3.0])
    robot.commands_are(2 * (2 * np.pi - 6.0), -12.0)


def test_gains_change_in_a_run_without_a_jump_of_the_integral():
    robot = started(gains={"p": 1.0, "i": 5.0})
    robot.give("positions", positions=[0.4, -0.2])
    for _ in range(50):
        before = robot.commanded()
    robot.change(gains={"p": 1.0, "i": {"a": 10.0, "b": 0.0}})
    np.testing.assert_allclose(robot.commanded() - before, [10 * 0.1 * PERIOD, 0.0], atol=1e-12)
    robot.change(gains={"p": 1.0})
    robot.commands_are(0.1, 0.0)


@pytest.mark.parametrize("interface", ["effort", "velocity", "pwm", "position"])
def test_a_joint_that_was_never_heard_gets_nothing_of_its_own(interface):
    robot, none = Law(command_interface=interface), [0.0, 0.0]
    robot.states.position[0], robot.states.valid[0] = np.nan, False
    robot.sent.position[0] = np.nan
    robot.activate()
    if interface == "position":
        robot.commands_are(np.nan, -0.2)
        return
    robot.commands_are(*none)
    robot.states.position[0], robot.states.valid[0] = 1.0, True
    robot.commands_are(*none)  # held where it was heard
    robot.states.position[0] = 0.9
    robot.commands_are(0.2, 0.0)


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
    robot = started(gains={"p": 2.0, "i": 1.0})
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
