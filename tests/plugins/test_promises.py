"""What every standard controller promises, whatever its law is."""

import tracemalloc

import numpy as np
import pytest
from tests.kit.campaigns import campaign
from tests.kit.laws import CONTROLLERS, Story, cases
from tests.kit.stages import Stage

from dxlrun_controllers.joint_state_broadcaster import JointStateBroadcaster

PHYSICS = pytest.mark.needs("physics")
EACH = pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, id=case.name, marks=[PHYSICS] * case.name.startswith("gravity_compensation"))
        for case in cases()
    ],
)


def test_no_type_is_left_out():
    assert {case.type for case in cases()} == set(CONTROLLERS)


@EACH
def test_its_parameters_survive_the_plan_and_an_unknown_key_is_refused(case):
    model = case.controller.Parameters.model_validate(case.keys)
    assert case.controller.Parameters.model_validate_json(model.model_dump_json()) == model
    with pytest.raises(ValueError, match="Extra inputs are not permitted"):
        case.controller.Parameters.model_validate({**case.keys, "surplus": 1})


@EACH
@campaign(ci=2, night=20, release=200)
def test_what_was_commanded_once_stays_a_finite_number(case, number):
    """The contract: infinity, and NaN behind a number, are its faults, and end it."""
    stage = case.stage()
    if number == 0:  # nothing was heard of any joint yet
        stage.states.motion[:] = stage.sent.values[:] = np.nan
        stage.states.valid[:] = False
    stage.activate()
    known = np.zeros(stage.commands.values.size + stage.context.device_commands.size, dtype=bool)
    for commanded in Story(stage, case, number).cycles(300):
        assert not np.isinf(commanded).any()
        assert np.isfinite(commanded[known]).all()
        known |= np.isfinite(commanded)


@EACH
def test_the_same_story_gives_the_same_commands_to_the_bit(case):
    """A replay computes anew what a run computed."""
    first, second = (list(Story(case.stage().activate(), case, 5).cycles(200)) for _ in range(2))
    np.testing.assert_array_equal(np.array(first).view(np.int64), np.array(second).view(np.int64))


@EACH
@campaign(ci=2, night=20, release=200)
def test_activated_again_it_does_what_a_new_one_does(case, number):
    old = case.stage().activate()
    story = Story(old, case, number)
    for _ in story.cycles(120):
        pass
    if number % 2:  # one that a fault ended is not called
        old.controller.on_deactivate(old.time_ns)
    story.end_goal()
    old.controller.parameters = old.model
    old.controller.on_parameters(old.time_ns)
    new = case.stage()
    new.time_ns = old.time_ns
    for stage in (old, new):
        stage.states.motion[:] = 0.2
        stage.states.valid[:] = True
        stage.states.temperature[:], stage.states.voltage[:] = 55.0, 11.0
        stage.sent.values[:] = stage.commands.values[:] = np.nan
        stage.context.references.values[:] = stage.context.reads[:] = np.nan
        stage.context.device_commands[:] = np.nan
        stage.activate()
    for ours, others in zip(
        Story(old, case, quiet=True).cycles(60), Story(new, case, quiet=True).cycles(60), strict=True
    ):
        np.testing.assert_array_equal(ours, others)


@EACH
def test_no_memory_grows_in_the_loop(case):
    stage = case.stage().activate()
    story = Story(stage, case, quiet=True)
    for kind, command in case.asks[-1:]:
        stage.send(None, kind, **command)
    for _ in story.cycles(60):
        stage.messages.clear()
    tracemalloc.start()
    try:
        for _ in range(10):
            stage.controller.update(stage.time_ns, story.period_ns)
        before, _ = tracemalloc.get_traced_memory()
        for _ in range(400):
            stage.controller.update(stage.time_ns, story.period_ns)
            stage.messages.clear()
            for goal in stage.goals:
                goal.progresses.clear()
        assert tracemalloc.get_traced_memory()[0] - before < 4000  # a float a cycle would be 9600
    finally:
        tracemalloc.stop()


def test_the_broadcaster_publishes_each_update():
    robot = Stage(JointStateBroadcaster, {}).activate()
    assert JointStateBroadcaster.publishes == ("/joint_states",)
    for time in range(3):
        robot.update(time)
    assert len(robot.messages) == 3
    assert np.isnan(robot.commands.position).all()
