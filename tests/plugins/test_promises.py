"""What every standard controller promises, whatever its law is."""

import math
import tracemalloc
from dataclasses import replace
from typing import Any

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


def sent_to(value: Any, goal: float, key: str = "") -> Any:
    """Return the content of a command, or a controller's keys, with this goal for each position."""
    if isinstance(value, dict):
        return {
            name: f"{goal} rad" if key == "pose" else sent_to(one, goal, name)
            for name, one in value.items()
            if not (name == "velocities" and "time" in value)
        }
    if key in ("positions", "rows") and isinstance(value, list):
        return [sent_to(one, goal, key) if isinstance(one, list) else goal for one in value]
    if isinstance(value, list | tuple):
        return [sent_to(one, goal) for one in value]
    return goal if key == "position" else value


TO_POSITIONS = [
    case
    for case in cases()
    if "velocity"
    not in (case.keys.get("reference"), "sample_player" in case.type and case.keys["command_interface"])
    and any(kind == "play" or sent_to(data, 0.0) != data for kind, data in case.asks)
]


@pytest.mark.parametrize("case", TO_POSITIONS, ids=lambda case: case.name)
def test_joint_that_wraps_takes_the_shorter_way(case):
    """From 1 deg before half a turn to 1 deg behind it: by 2 deg, and not by 358 deg."""
    begin, goal = math.radians(179), math.radians(-179)
    keys = sent_to(case.keys, goal)
    if "wrap" in case.controller.Parameters.model_fields:
        keys["wrap"] = keys["joints"]
    assert case.asks
    for kind, data in case.asks:
        stage = replace(case, keys=keys).stage(present=begin, wrap=True, limits={}).activate()
        stage.states.temperature[:], stage.states.effort[:], stage.states.age_ns[:] = 45.0, 0.0, 1000
        stage.send(0.0, kind, **sent_to(data, goal))
        places = []
        for cycle in range(1, 150):
            stage.update(0.02 * cycle, follow=False)
            commands, place = stage.commands, stage.states.position
            driven = np.nan_to_num([commands.velocity, commands.effort, commands.pwm]).sum(axis=0)
            np.copyto(
                place, np.where(np.isfinite(commands.position), commands.position, place + 0.02 * driven)
            )
            places.append(place.copy())
        assert np.abs(np.array(places) - begin).max() < math.pi
        if "position" in stage.interfaces.command and "pid" not in case.type and kind != "rows":
            assert places[-1][0] == pytest.approx(begin + math.radians(2), abs=math.radians(0.5))


def test_the_broadcaster_publishes_each_update():
    robot = Stage(JointStateBroadcaster, {}).activate()
    assert JointStateBroadcaster.publishes == ("/joint_states",)
    for time in range(3):
        robot.update(time)
    assert len(robot.messages) == 3
    assert np.isnan(robot.commands.position).all()
