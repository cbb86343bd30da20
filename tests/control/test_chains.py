"""Chains: controllers that command the references of others in the same cycle, or provide states."""

import math

import numpy as np
import pytest
from tests.kit.loops import PERIOD_NS, Robot, commanding, following, on_update

NAN = np.nan
CHAINED = {"command": ("position",)}
LOWER = CHAINED | {"reference": ("position",)}
UPPER = CHAINED | {"into": ("lower",)}


def first(robot, name="position"):
    """Run a cycle; return something of its record."""
    robot.run(1)
    return robot.sink.cycles[0][name].tolist()


@pytest.mark.parametrize("joints", [("j0", "j1"), ("j1", "j0"), ("j3", "j0", "j2")])
def test_joints_of_both_ends_are_matched_by_their_names(joints):
    robot = Robot(joints=4).script("lower", following, joints=("j2", "j0", "j3", "j1"), **LOWER)
    wanted = {f"j{row}": 0.1 * row + 0.1 for row in range(4)}
    robot.script("upper", commanding(position=[wanted[joint] for joint in joints]), joints=joints, **UPPER)
    assert first(robot) == [wanted[joint] if joint in joints else 0.25 for joint in robot.names]


def test_a_controller_sees_its_references_and_what_it_commands(robot):
    """A reference that is not commanded is NaN; nothing of it, or of the reads, can be written."""
    seen = {}

    def looks(context, *_):
        seen[context.name] = (context.into, context.references.position.tolist())
        context.commands.position[:] = 0.0
        for array in (context.references.position, context.reads):
            with pytest.raises(ValueError, match="read-only"):
                array[:] = 1.0

    robot.script("lower", on_update(looks), reads=("j0/position",), **LOWER)
    robot.script("upper", on_update(looks), joints=("j0",), reads=("j0/position",), **UPPER)
    assert robot.run(1).detail == ""
    assert [into for into, _ in seen.values()] == [("lower",), ()]
    np.testing.assert_array_equal(seen["lower"][1], [0.0, NAN])


def test_what_is_read_without_a_claim_is_of_this_cycle(robot):
    seen = []
    reads = "lower/j1/position j1/position j0/velocity j1/age j0/age j0/temperature j1/effort"
    look = on_update(lambda context, *_: seen.append(context.reads.copy()))
    robot.script("eye", look, joints=(), command=(), reads=tuple(reads.split()))
    robot.script("lower", following, **LOWER).script("upper", commanding(position=0.3), **UPPER).build()
    states, read = robot.record.states, robot.hardware.read_states
    states.velocity[0], states.effort[1], states.temperature[0] = 2.0, 0.5, 41.0

    def hardware_read():
        read()
        states.age_ns[:] = [-1, 3_000_000]

    robot.hardware.read_states = hardware_read
    robot.run(1)
    here = float(states.position[1])
    np.testing.assert_allclose(seen[0], [0.3, here, 2.0, 0.003, NAN, 41.0, 0.5])


def test_a_slower_controller_above_leaves_its_reference_in_between(robot):
    counts = on_update(lambda context, time_ns, _: context.commands.position.fill(time_ns / PERIOD_NS / 100))
    robot.script("lower", following, **LOWER).script("upper", counts, every=3, **UPPER).run(6)
    np.testing.assert_allclose(robot.column("position", 0), [0, 0, 0, 0.03, 0.03, 0.03], atol=1e-9)


@pytest.mark.parametrize("wrong", [NAN, math.inf])
def test_what_is_provided_is_read_in_its_cycle_and_grows_older(robot, wrong):
    """One value that is not known makes all of them invalid."""
    steps = (  # what is provided, what a reader gets of it with the age, and what the record has
        ((NAN, NAN), (NAN, NAN, NAN), (False, -1)),
        ((1.0, 2.0), (1.0, 2.0, 0.0), (True, 0)),
        ((3.0, 4.0), (3.0, 4.0, 0.0), (True, 0)),
        ((NAN, NAN), (3.0, 4.0, 0.02), (False, PERIOD_NS)),
        ((NAN, NAN), (3.0, 4.0, 0.04), (False, 2 * PERIOD_NS)),
        ((5.0, 6.0), (5.0, 6.0, 0.0), (True, 0)),
        ((7.0, wrong), (7.0, wrong, 0.02), (False, PERIOD_NS)),
        ((math.inf, NAN), (math.inf, NAN, 0.04), (False, 2 * PERIOD_NS)),
    )
    read, shown = [], []

    def provide(context, time_ns, _):
        context.provided[:] = steps[round(time_ns / PERIOD_NS)][0]

    def look(context, *_):
        read.append(context.reads.tolist())
        sources = robot.record.sources
        shown.append((bool(sources.valid[0]), int(sources.age_ns[0])))
        np.testing.assert_array_equal(sources.values, read[-1][:2])

    names, none = ("imu/a", "imu/b", "imu/age"), {"joints": (), "command": ()}
    robot.script("reader", on_update(look), reads=names, **none)  # in the file before the other one
    robot.script("imu", on_update(provide), provides=("a", "b"), **none)
    assert robot.run(len(steps)).reason == "stopped"
    np.testing.assert_array_equal(read, [expected for _, expected, _ in steps])
    assert shown == [expected for *_, expected in steps]
