"""Claims, hand-over of commands, rates, and what happens to a controller that breaks its contract."""

import signal

import numpy as np
import pytest
from tests.kit.loops import PERIOD_NS, Robot, Scripted, commanding, on_update

from dxlrun.channels.event_records import EventCode
from dxlrun.errors import ControllerFault, PlugInError

NAN = np.nan
ONE = {"joints": ("j0",), "command": ("position",)}
OTHER = {"joints": ("j1",), "command": ("position",)}


def last(robot, name):
    return robot.sink.cycles[-1][name].tolist()


def test_commands_of_several_controllers_are_merged_by_joint(robot):
    robot.script("left", commanding(position=0.3, velocity=0.7), **ONE)  # the velocity is not claimed
    robot.script("right", commanding(position=0.2, velocity=0.5), joints=("j1",)).run(3)
    np.testing.assert_array_equal(last(robot, "position"), [0.3, 0.2])
    np.testing.assert_array_equal(last(robot, "velocity"), [NAN, 0.5])


ROWS = [(1, 0), (0,), (1, 2), (0, 4), (4, 0), (0, 2, 4), (4, 2, 0), (5, 3, 1), (0, 1, 3), (2, 5, 0, 1)]


@pytest.mark.parametrize("rows", ROWS)
def test_joints_in_any_order_are_seen_and_commanded_as_named(rows):
    robot, seen, wanted = Robot(joints=6), [], {row: 0.1 * row - 0.2 for row in rows}

    def act(self, step, *_):
        context = self.context
        if step != "deactivate":
            seen.append((context.states.position.copy(), context.goals.position.copy()))
        context.commands.position[:] = [wanted[row] for row in rows]

    robot.script("some", act, joints=tuple(f"j{row}" for row in rows), command=("position",)).build()
    robot.record.states.position[:] = robot.record.goals.position[:] = 0.01 * np.arange(6)
    robot.run(3)
    for one in seen[:2]:  # as it is activated, and in its first update
        np.testing.assert_array_equal(one, [0.01 * np.array(rows)] * 2)
    for cycle in robot.column("position"):
        np.testing.assert_array_equal(cycle, [wanted.get(row, NAN) for row in range(6)])


def test_a_command_that_stands_comes_back_behind_a_pause_and_nan_is_a_fault_there(robot):
    values = [0.3]
    robot.script("still", on_update(lambda context, *_: context.commands.position.fill(values[-1])), **ONE)
    paused = {5: robot.asks("pause"), 8: robot.asks("resume"), 12: lambda: values.append(NAN)}
    result = robot.run(30, paused)
    assert np.isfinite(robot.column("position", 0)[:12]).tolist() == [True] * 5 + [False] * 3 + [True] * 4
    assert "commanded j0/position = nan after a finite value" in result.detail
    assert result.cycles == 13


def test_nan_is_accepted_until_the_first_finite_value_of_each_joint_and_interface(robot):
    def late(context, time_ns, _):
        context.commands.position[0] = 0.3
        if time_ns >= PERIOD_NS:
            context.commands.position[1] = 0.2

    robot.script("late", on_update(late))
    assert robot.run(4).reason == "stopped"
    np.testing.assert_array_equal(last(robot, "position"), [0.3, 0.2])
    assert robot.hardware.written[0][0].tolist() == [0.28, 0.25], "what is not commanded is held"


@pytest.mark.parametrize(
    ("bad", "what"), [(NAN, "j1/velocity = nan after a finite value"), (np.inf, "j1/velocity = inf")]
)
def test_a_value_that_stops_being_finite_is_the_controllers_fault(robot, bad, what):
    def act(context, time_ns, _):
        fails = time_ns >= 2 * PERIOD_NS
        context.commands.position[:] = 0.9 if fails else 0.26
        context.commands.velocity[:] = [0.5, bad if fails else 0.5]

    robot.script("failing", on_update(act))
    result = robot.run(9)
    assert (result.reason, result.cycles) == ("fault", 3)
    assert what in result.detail
    assert robot.record.clamped.tolist() == [0, 16]
    np.testing.assert_array_equal(robot.record.goals.values[:2], [[0.26] * 2, [0.5] * 2])


class Stubborn(KeyboardInterrupt):
    """Raised by a plug-in, not by Ctrl-C."""


@pytest.mark.parametrize("step", ["activate", "update", "command", "deactivate"])
@pytest.mark.parametrize(
    "raised",
    [ZeroDivisionError("oh"), SystemExit(3), GeneratorExit(), Stubborn(), BaseException("odd")],
    ids=repr,
)
def test_what_a_controller_raises_ends_it_alone(robot, step, raised):
    robot.script("failing", **ONE).script("healthy", commanding(position=0.27), **OTHER)
    robot.raises["failing", step] = raised
    robot.send(0, "failing", "anything")
    result = robot.run(4)
    assert result.reason == "fault"
    assert f"controller failing raised in on_{step}".replace("on_update", "update") in result.detail
    ((source, text),) = robot.events.of(EventCode.CONTROLLER_FAULT)
    assert source == "failing"
    assert "Traceback" in text
    assert "raise error" in text
    assert robot.record.active == 0
    if step in ("update", "command"):
        steps = [call.step for call in robot.calls if call.name == "healthy"]
        assert steps == ["activate", "update", "deactivate"]
        assert robot.record.goals.position.tolist() == [0.25, 0.27]


@pytest.mark.parametrize("ignored", [False, True])
def test_ctrl_c_of_a_process_that_has_it_is_no_fault_of_a_controller(robot, ignored):
    robot.script("busy").raises["busy", "update"] = KeyboardInterrupt()
    before = signal.signal(signal.SIGINT, signal.SIG_IGN if ignored else signal.default_int_handler)
    try:
        if ignored:  # as in the loop's own process
            assert "controller busy raised in update: KeyboardInterrupt" in robot.run(3).detail
        else:
            with pytest.raises(KeyboardInterrupt):
                robot.run(3)
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_wrong_shape_is_the_controllers_fault(robot):
    assert "could not broadcast" in robot.script("wrong", commanding(position=np.zeros(3))).run(3).detail


def test_commands_come_at_the_first_cycle_that_is_not_too_early(robot):
    robot.script("listener")
    robot.send(PERIOD_NS, "listener", "go", 1.0, 2.0)
    robot.send(PERIOD_NS + 1, "listener", "go", 3.0)
    robot.run(4)
    taken = [(call.time_ns, call.value.tolist()) for call in robot.calls if call.step == "command"]
    assert taken == [(PERIOD_NS, [1.0, 2.0]), (2 * PERIOD_NS, [3.0])]
    assert robot.events.of(EventCode.COMMAND) == [("listener", "go from motion.yaml:7:5")] * 2
    assert robot.column("command_count") == [0, 1, 1, 0]


def test_a_command_of_a_motion_to_a_controller_that_is_not_active_is_refused(robot):
    robot.script("asleep", active=False).send(0, "asleep", "go")
    robot.run(2)
    ((source, text),) = robot.events.of(EventCode.COMMAND_REFUSED)
    assert (source, text.partition(";")[0]) == (
        "asleep",
        "go from motion.yaml:7:5 refused: asleep is not active",
    )
    assert robot.column("command_count") == [0, 0]


def test_a_controller_is_updated_at_its_own_rate_with_its_true_period_at_most_five_nominal_ones(robot):
    robot.script("slow", every=3, joints=("j0",)).script("patient", joints=("j1",))
    robot.run(work={4: 3.5, 15: 50.0}, end_ns=80 * PERIOD_NS)
    seen = [(call.time_ns / PERIOD_NS, call.value / PERIOD_NS) for call in robot.calls if call.name == "slow"
            and call.step == "update"]  # fmt: skip
    assert seen[:7] == [(0, 3), (3, 3), (8, 5), (9, 1), (12, 3), (15, 3), (18, 3)]
    periods = [call.value for call in robot.calls if (call.name, call.step) == ("patient", "update")]
    assert max(periods) == 5 * PERIOD_NS


def test_the_first_update_after_an_activation_has_the_nominal_period(robot):
    at = {3: robot.switches((), ("left",)), 7: robot.switches(("left",))}
    robot.script("left").run(9, at)
    updates = [(call.cycle, call.value) for call in robot.calls if call.step == "update"]
    assert updates == [(cycle, PERIOD_NS) for cycle in (0, 1, 2, 7, 8)]


def test_masks_show_which_controllers_are_active_and_which_publish(robot):
    def speaks(context, time_ns, _):
        if time_ns == PERIOD_NS:
            context.publish()

    robot.script("quiet", active=False).script("speaker", on_update(speaks), command=()).run(3)
    assert robot.column("active") == [2, 2, 2]
    assert robot.column("published") == [0, 2, 0]
    assert robot.events.of(EventCode.CONTROLLER_ACTIVATED) == [("speaker", "active")]
    assert robot.events.of(EventCode.CONTROLLER_DEACTIVATED) == [("speaker", "inactive")]


def test_the_duration_of_each_update_is_recorded(robot):
    def thinks(*_):
        robot.clock.wait_until(robot.clock.now_ns() + 700)

    robot.script("quick", **ONE).script("thinker", on_update(thinks), **OTHER).run(1)
    assert robot.record.controller_ns.tolist() == [0, 700]


def test_what_cannot_be_configured_is_one_sentence(robot):
    class Unready(Scripted):
        def on_configure(self, context):
            raise OSError("no file")

    robot.script("present")
    robot._offers.clear()
    with pytest.raises(PlugInError, match=r"type present of controller present .*broken_one of x 1"):
        robot.build()
    with pytest.raises(PlugInError, match=r"strict.* unknown key .surplus.; remove it"):
        Robot().add("strict", Scripted, parameters='{"surplus": 1}').build()
    with pytest.raises(ControllerFault, match="controller unready raised in on_configure: OSError: no file"):
        Robot().add("unready", Unready).build()


def test_joints_of_a_faulty_controller_stop_where_the_gate_last_let_them():
    robot = Robot(velocity=1.0).script("failing", commanding(position=0.9))
    assert robot.run(9, {2: robot.breaks("failing")}).cycles == 3
    np.testing.assert_allclose([position[0] for position, _ in robot.hardware.written], [0.27, 0.29, 0.29])
    assert np.isnan(last(robot, "position")).all()
