"""Chains: controllers that command the references of others, in the same cycle."""

import numpy as np
import pytest

from dxlrun.errors import ControllerFault

PERIOD_NS = 20_000_000
NAN = np.nan


def commands(**values):
    """Return an act that commands these values in each update."""

    def act(self, step, time_ns, _):
        if step == "update":
            for interface, value in values.items():
                getattr(self.context.commands, interface)[:] = value

    return act


def follows(self, step, time_ns, _):
    """Command the references, and hold where there is none."""
    if step == "update":
        given = self.context.references.position
        here = np.where(np.isnan(given), self.context.states.position, given)
        np.copyto(self.context.commands.position, here)


def run(robot, cycles):
    robot.build(end_ns=cycles * PERIOD_NS)
    return robot.loop.run()


def test_a_reference_reaches_the_servo_in_the_cycle_that_commands_it(robot):
    robot.script("lower", follows, command=("position",), reference=("position",))
    robot.script("upper", commands(position=0.3), command=("position",), into=("lower",))
    run(robot, 1)
    assert robot.manager.active == ()
    np.testing.assert_array_equal(robot.sink.cycles[0]["position"], [0.3, 0.3])


def test_the_record_names_each_reference_and_has_its_value(robot):
    robot.script("lower", follows, command=("position",), reference=("position", "effort"))
    robot.script("upper", commands(position=[0.1, 0.2]), command=("position",), into=("lower",))
    run(robot, 1)
    assert robot.record.layout.references == (
        "lower/j0/position",
        "lower/j1/position",
        "lower/j0/effort",
        "lower/j1/effort",
    )
    np.testing.assert_array_equal(robot.sink.cycles[0]["reference"], [0.1, 0.2, NAN, NAN])


@pytest.mark.parametrize("joints", [("j0", "j1"), ("j1", "j0"), ("j3", "j0", "j2")])
def test_joints_of_both_ends_are_matched_by_their_names(make_robot, joints):
    robot = make_robot(joints=4)
    robot.script(
        "lower", follows, joints=("j2", "j0", "j3", "j1"), command=("position",), reference=("position",)
    )
    wanted = {f"j{row}": 0.1 * row + 0.1 for row in range(4)}
    robot.script(
        "upper",
        commands(position=[wanted[joint] for joint in joints]),
        joints=joints,
        command=("position",),
        into=("lower",),
    )
    run(robot, 1)
    expected = [wanted[joint] if joint in joints else 0.25 for joint in robot.names]
    np.testing.assert_array_equal(robot.sink.cycles[0]["position"], expected)


def test_two_controllers_meet_in_one_on_different_joints(make_robot):
    robot = make_robot(joints=3)
    robot.script("lower", follows, command=("position",), reference=("position",))
    robot.script("left", commands(position=0.4), joints=("j0",), command=("position",), into=("lower",))
    robot.script("right", commands(position=0.5), joints=("j2",), command=("position",), into=("lower",))
    run(robot, 1)
    position = robot.sink.cycles[0]["position"]
    assert (position[0], position[2]) == (0.4, 0.5)


def test_two_controllers_meet_in_one_on_different_interfaces_of_a_joint(robot):
    def sums(self, step, time_ns, _):
        if step == "update":
            references = self.context.references
            np.add(references.position, references.effort, out=self.context.commands.position)

    robot.script("lower", sums, command=("position",), reference=("position", "effort"))
    robot.script("path", commands(position=0.25), command=("position",), into=("lower",))
    robot.script("gravity", commands(effort=0.125), command=("effort",), into=("lower",))
    run(robot, 1)
    np.testing.assert_array_equal(robot.sink.cycles[0]["position"], [0.375, 0.375])


def test_two_controllers_cannot_command_one_reference(robot):
    robot.script("lower", follows, command=("position",), reference=("position",))
    robot.script("first", commands(position=0.4), command=("position",), into=("lower",))
    robot.script("second", commands(position=0.5), joints=("j1",), command=("position",), into=("lower",))
    with pytest.raises(ControllerFault, match="first and second both command lower/j1/position"):
        robot.build()


def test_three_in_a_chain_are_updated_from_the_top_wherever_they_are_in_the_file(robot):
    order = []

    def passes(self, step, time_ns, _):
        if step == "update":
            order.append(self.context.name)
            follows(self, step, time_ns, _)

    chained = {"command": ("position",)}
    robot.script("middle", passes, into=("bottom",), reference=("position",), **chained)
    robot.script("bottom", passes, reference=("position",), **chained)
    robot.script("top", commands(position=0.7), into=("middle",), **chained)
    run(robot, 2)
    assert order == ["middle", "bottom"] * 2
    np.testing.assert_array_equal(robot.sink.cycles[0]["position"], [0.7, 0.7])


def test_a_reference_that_is_not_commanded_is_nan(robot):
    seen = []

    def looks(self, step, time_ns, _):
        if step == "update":
            seen.append(self.context.references.position.copy())
            self.context.commands.position[:] = 0.0

    robot.script("lower", looks, command=("position",), reference=("position",))
    robot.script("upper", commands(position=0.3), joints=("j0",), command=("position",), into=("lower",))
    run(robot, 1)
    np.testing.assert_array_equal(seen[0], [0.3, NAN])


def test_a_controller_knows_whether_it_commands_servos(robot):
    seen = {}

    def looks(self, step, time_ns, _):
        seen[self.context.name] = self.context.into

    robot.script("lower", looks, reference=("position",), command=("position",))
    robot.script("upper", looks, command=("position",), into=("lower",))
    run(robot, 1)
    assert seen == {"lower": (), "upper": ("lower",)}


def test_references_and_reads_cannot_be_written(robot):
    def writes(self, step, time_ns, _):
        if step == "update":
            array = self.context.references.position if self.context.name == "a" else self.context.reads
            with pytest.raises(ValueError, match="read-only"):
                array[:] = 1.0

    robot.script("a", writes, command=("position",), reference=("position",))
    robot.script("b", writes, command=(), reads=("j0/position",))
    assert run(robot, 1).detail == ""


def test_what_is_read_without_a_claim_is_of_this_cycle(robot):
    seen = []

    def looks(self, step, time_ns, _):
        if step == "update":
            seen.append(self.context.reads.copy())

    reads = (
        "lower/j1/position",
        "j1/position",
        "j0/velocity",
        "j1/age",
        "j0/age",
        "j0/temperature",
        "j1/effort",
    )
    robot.script("eye", looks, joints=(), command=(), reads=reads)
    robot.script("lower", follows, command=("position",), reference=("position",))
    robot.script("upper", commands(position=0.3), command=("position",), into=("lower",))
    robot.build(end_ns=PERIOD_NS)
    states = robot.record.states
    states.velocity[0], states.effort[1], states.temperature[0] = 2.0, 0.5, 41.0
    read = robot.hardware.read

    def hardware_read():
        read()
        states.age_ns[:] = [-1, 3_000_000]

    robot.hardware.read = hardware_read
    robot.loop.run()
    here = float(states.position[1])
    np.testing.assert_allclose(seen[0], [0.3, here, 2.0, 0.003, NAN, 41.0, 0.5])


@pytest.mark.parametrize("name", ["j7/position", "j0/torque", "upper/j0/position", "position", "a/b/c/d"])
def test_what_is_not_there_cannot_be_read(robot, name):
    robot.script("eye", follows, joints=(), command=(), reads=(name,))
    with pytest.raises(ControllerFault, match=f"controller eye reads {name}, which is not there"):
        robot.build()


def test_a_reference_that_no_controller_exports_cannot_be_commanded(robot):
    robot.script("lower", follows, joints=("j0",), command=("position",), reference=("position",))
    robot.script("upper", commands(position=0.3), command=("position",), into=("lower",))
    with pytest.raises(ControllerFault, match="upper commands j1/position, which none of lower exports"):
        robot.build()


def test_a_reference_that_two_of_those_below_export_cannot_be_commanded(robot):
    one = {"joints": ("j0",), "command": ("position",)}
    for name in ("left", "right"):
        robot.script(name, follows, reference=("position",), active=name == "left", **one)
    robot.script("upper", commands(position=0.3), into=("left", "right"), **one)
    with pytest.raises(ControllerFault, match="j0/position, which more than one of left, right exports"):
        robot.build()


def test_a_slower_controller_above_leaves_its_reference_in_between(robot):
    robot.script("lower", follows, command=("position",), reference=("position",))

    def counts(self, step, time_ns, _):
        if step == "update":
            self.context.commands.position[:] = time_ns / PERIOD_NS / 100

    robot.script("upper", counts, command=("position",), into=("lower",), every=3)
    run(robot, 6)
    positions = [cycle["position"][0] for cycle in robot.sink.cycles]
    np.testing.assert_allclose(positions, [0, 0, 0, 0.03, 0.03, 0.03], atol=1e-9)
