"""Claims, hand-over of commands, rates, and what happens to a controller that breaks its contract."""

import signal

import numpy as np
import pytest

from dxlrun.channels.events import EventCode
from dxlrun.control.controllers.claims import Conflict, conflicts
from dxlrun.errors import ControllerFault, PlugInError

PERIOD_NS = 20_000_000


def writes(position, velocity=np.nan):
    def act(self, step, time_ns, _):
        if step == "update":
            self.context.commands.position[:] = position
            self.context.commands.velocity[:] = velocity

    return act


def idle(self, step, time_ns, _):
    pass


def run(robot, cycles):
    robot.build(end_ns=cycles * PERIOD_NS)
    return robot.loop.run()


def test_two_active_controllers_cannot_have_one_joint(robot):
    robot.script("first", idle, joints=("j0", "j1"), command=("position",))
    robot.script("second", idle, joints=("j1",), command=("velocity",))
    with pytest.raises(ControllerFault, match="first and second both command joint j1"):
        robot.build()


def test_an_inactive_controller_and_one_that_only_looks_may_share_joints(robot):
    robot.script("first", idle)
    robot.script("spare", idle, active=False)
    robot.script("viewer", idle, command=())
    robot.build()
    assert list(conflicts(robot.plan.controllers)) == [
        Conflict("j0", "first", "spare"),
        Conflict("j1", "first", "spare"),
    ]


def test_commands_of_several_controllers_are_merged_by_joint(robot):
    robot.script("left", writes(0.3), joints=("j0",), command=("position",))
    robot.script("right", writes(0.2, 0.5), joints=("j1",))
    run(robot, 3)
    np.testing.assert_array_equal(robot.sink.cycles[-1]["position"], [0.3, 0.2])
    np.testing.assert_array_equal(robot.sink.cycles[-1]["velocity"], [np.nan, 0.5])


def test_a_controller_that_leaves_leaves_no_command_and_begins_without_one(robot):
    values = {"now": 0.3}

    def act(self, step, time_ns, _):
        if step == "update" and values["now"] is not None:
            self.context.commands.position[:] = values["now"]
            self.context.commands.velocity[:] = 0.5

    robot.script("own", act)
    robot.build(end_ns=10 * PERIOD_NS)

    def idle_(deadline_ns):
        if len(robot.sink.cycles) == 3:
            values["now"] = None
            robot.ask("switch", deactivate=["own"])
        if len(robot.sink.cycles) == 6:
            robot.ask("switch", activate=["own"])

    robot.hardware.idle = idle_
    robot.loop.run()
    for name, value in (("position", 0.3), ("velocity", 0.5)):
        sent = [cycle[name].tolist() for cycle in robot.sink.cycles]
        assert sent[:3] == [[value, value]] * 3
        assert np.isnan(sent[3:]).all()
    assert [cycle["active"] for cycle in robot.sink.cycles] == [1] * 3 + [0] * 3 + [1] * 4


def test_a_controller_sees_its_joints_in_its_own_order(robot):
    seen = []

    def act(self, step, time_ns, _):
        if step in ("activate", "update"):
            seen.append((self.context.states.position.copy(), self.context.goals.position.copy()))

    robot.script("turned", act, joints=("j1", "j0"), command=("position",))
    robot.build(end_ns=PERIOD_NS)
    robot.record.goals.position[:] = [0.1, 0.2]
    robot.loop.run()
    for states, goals in seen[1:]:
        np.testing.assert_array_equal(states, [0.2, 0.1])
        np.testing.assert_array_equal(goals, [0.2, 0.1])
    np.testing.assert_array_equal(seen[0][1], [0.2, 0.1])


@pytest.mark.parametrize(
    "rows",
    [(0,), (1, 2), (0, 4), (4, 0), (0, 2, 4), (4, 2, 0), (5, 3, 1), (0, 1, 3), (3, 0, 1), (2, 5, 0, 1)],
)
def test_joints_in_any_order_are_seen_and_commanded_as_named(make_robot, rows):
    robot = make_robot(joints=6)
    seen, wanted = [], {row: 0.1 * row - 0.2 for row in rows}

    def act(self, step, time_ns, _):
        if step == "update":
            seen.append((self.context.states.position.copy(), self.context.goals.position.copy()))
            self.context.commands.position[:] = [wanted[row] for row in rows]

    robot.script("some", act, joints=tuple(f"j{row}" for row in rows), command=("position",))
    robot.build(end_ns=3 * PERIOD_NS)
    robot.record.states.position[:] = robot.record.goals.position[:] = 0.01 * np.arange(6)
    robot.loop.run()
    np.testing.assert_array_equal(seen[0][0], 0.01 * np.array(rows))
    np.testing.assert_array_equal(seen[0][1], 0.01 * np.array(rows))
    expected = [wanted.get(row, np.nan) for row in range(6)]
    for cycle in robot.sink.cycles:
        np.testing.assert_array_equal(cycle["position"], expected)


def test_a_command_that_stands_comes_back_behind_a_pause(robot):
    robot.script("still", writes(0.3), joints=("j1",), command=("position",))
    robot.build(end_ns=30 * PERIOD_NS)
    wishes = {5: "pause", 8: "resume"}

    def idle_(deadline_ns):
        if wish := wishes.pop(len(robot.sink.cycles), None):
            robot.ask(wish)

    robot.hardware.idle = idle_
    robot.loop.run()
    shown = [bool(np.isfinite(cycle["position"][1])) for cycle in robot.sink.cycles[:12]]
    assert shown == [True] * 5 + [False] * 3 + [True] * 4


def test_nan_behind_a_pause_is_a_fault_of_whoever_was_finite_before(robot):
    values = {"now": 0.3}

    def act(self, step, time_ns, _):
        if step == "update":
            self.context.commands.position[:] = values["now"]

    robot.script("breaks", act, joints=("j0",), command=("position",))
    robot.build(end_ns=30 * PERIOD_NS)

    def idle_(deadline_ns):
        cycles = len(robot.sink.cycles)
        if cycles in (5, 8):
            robot.ask({5: "pause", 8: "resume"}[cycles])
        if cycles == 8:
            values["now"] = np.nan

    robot.hardware.idle = idle_
    result = robot.loop.run()
    assert "commanded j0/position = nan after a finite value" in result.detail


def test_an_unclaimed_interface_is_not_taken(robot):
    robot.script("position_only", writes(0.3, 0.7), command=("position",))
    run(robot, 2)
    np.testing.assert_array_equal(robot.sink.cycles[-1]["position"], 0.3)
    assert np.isnan(robot.sink.cycles[-1]["velocity"]).all()


def test_nan_before_the_first_finite_value_is_held(robot):
    robot.script("silent", idle)
    result = run(robot, 5)
    assert result.reason == "ended"
    for position, _ in robot.hardware.written:
        np.testing.assert_array_equal(position, 0.25)


@pytest.mark.parametrize(
    ("bad", "what"), [(np.nan, "j1/velocity = nan after a finite value"), (np.inf, "j1/velocity = inf")]
)
def test_a_value_that_stops_being_finite_is_the_controllers_fault(robot, bad, what):
    def act(self, step, time_ns, _):
        if step == "update":
            self.context.commands.position[:] = 0.26
            self.context.commands.velocity[:] = 0.5
            if time_ns >= 2 * PERIOD_NS:
                self.context.commands.velocity[1] = bad
                self.context.commands.position[:] = 0.9

    robot.script("failing", act)
    result = run(robot, 9)
    assert (result.reason, result.cycles) == ("fault", 3)
    assert what in result.detail
    np.testing.assert_array_equal(robot.record.clamped, [0, 16])
    np.testing.assert_array_equal(robot.record.goals.position, 0.26)
    np.testing.assert_array_equal(robot.record.goals.velocity, 0.5)


def test_infinity_is_a_fault_from_the_first_cycle(robot):
    robot.script("wild", writes(-np.inf))
    result = run(robot, 9)
    assert (result.reason, result.cycles) == ("fault", 1)
    np.testing.assert_array_equal(robot.record.goals.position, 0.25)


def test_nan_is_accepted_per_joint_and_interface(robot):
    def act(self, step, time_ns, _):
        if step == "update":
            self.context.commands.position[0] = 0.3
            if time_ns >= PERIOD_NS:
                self.context.commands.position[1] = 0.2

    robot.script("late", act)
    assert run(robot, 4).reason == "ended"
    np.testing.assert_array_equal(robot.sink.cycles[-1]["position"], [0.3, 0.2])


class Stubborn(KeyboardInterrupt):
    """Raised by a plug-in, not by Ctrl-C."""


@pytest.mark.parametrize("step", ["activate", "update", "command", "deactivate"])
@pytest.mark.parametrize(
    "raised",
    [ZeroDivisionError("oh"), SystemExit(3), GeneratorExit(), Stubborn(), BaseException("odd")],
    ids=repr,
)
def test_what_a_controller_raises_ends_it_alone(robot, step, raised):
    updates = []

    def act(self, now, time_ns, _):
        if now == step:
            raise raised

    def other(self, now, time_ns, _):
        updates.append(now)
        self.context.commands.position[:] = 0.27

    robot.script("failing", act, joints=("j0",))
    robot.script("healthy", other, joints=("j1",))
    robot.send(0, "failing", "anything")
    result = run(robot, 4)
    assert result.reason == "fault"
    assert f"controller failing raised in on_{step}".replace("on_update", "update") in result.detail
    ((source, text),) = robot.events.of(EventCode.CONTROLLER_FAULT)
    assert source == "failing"
    assert "Traceback" in text
    assert "raise raised" in text
    assert updates[-1] == "deactivate"
    assert robot.record.active == 0
    if step in ("update", "command"):
        assert updates == ["activate", "update", "deactivate"]
        np.testing.assert_array_equal(robot.record.goals.position, [0.25, 0.27])


@pytest.mark.parametrize("ignored", [False, True])
def test_ctrl_c_of_a_process_that_has_it_is_no_fault_of_a_controller(robot, ignored):
    def act(self, now, time_ns, _):
        if now == "update":
            raise KeyboardInterrupt

    robot.script("busy", act)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN if ignored else signal.default_int_handler)
    try:
        if ignored:  # as in the loop's own process
            assert "controller busy raised in update: KeyboardInterrupt" in run(robot, 3).detail
        else:
            with pytest.raises(KeyboardInterrupt):
                run(robot, 3)
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_wrong_shape_is_the_controllers_fault(robot):
    def act(self, step, time_ns, _):
        self.context.commands.position[:] = np.zeros(3)

    robot.script("misshapen", act)
    assert "could not broadcast" in run(robot, 3).detail


def test_commands_come_at_the_first_cycle_that_is_not_too_early(robot):
    taken = []

    def act(self, step, time_ns, data):
        if step == "command":
            taken.append((time_ns, list(data), self.context.goals.position.copy()))

    robot.script("listener", act)
    robot.send(PERIOD_NS, "listener", "go", 1.0, 2.0)
    robot.send(PERIOD_NS + 1, "listener", "go", 3.0)
    run(robot, 4)
    assert [(time, data) for time, data, _ in taken] == [(PERIOD_NS, [1.0, 2.0]), (2 * PERIOD_NS, [3.0])]
    np.testing.assert_array_equal(taken[0][2], 0.25)
    assert robot.events.of(EventCode.COMMAND) == [("listener", "go from motion.yaml:7:5")] * 2
    assert [cycle["command_count"] for cycle in robot.sink.cycles] == [0, 1, 1, 0]


def test_commands_to_controllers_that_are_not_there_are_refused_in_words(robot):
    robot.script("asleep", idle, active=False)
    robot.send(0, "asleep", "go")
    robot.send(0, "unknown", "go")
    assert run(robot, 2).reason == "ended"
    assert robot.events.of(EventCode.COMMAND_REFUSED) == [
        ("asleep", "go from motion.yaml:7:5 refused: asleep is not active; switch to it first"),
        ("unknown", "go from motion.yaml:7:5 refused: there is no controller unknown"),
    ]


def test_a_slower_controller_is_updated_at_its_own_rate_with_its_true_period(robot):
    periods = []

    def act(self, step, time_ns, period_ns):
        if step == "update":
            periods.append((time_ns // PERIOD_NS, period_ns // PERIOD_NS))

    robot.script("slow", act, every=3)
    robot.build(end_ns=20 * PERIOD_NS)
    work = iter([0, 0, 0, 0, int(3.5 * PERIOD_NS)])
    robot.hardware.work_ns = lambda: next(work, 0)
    robot.loop.run()
    assert periods == [(0, 3), (3, 3), (8, 5), (9, 1), (12, 3), (15, 3), (18, 3)]


def test_the_period_that_a_controller_sees_is_capped(robot):
    periods = []

    def act(self, step, time_ns, period_ns):
        if step == "update":
            periods.append(period_ns)

    robot.script("patient", act)
    robot.build(end_ns=60 * PERIOD_NS)
    work = iter([0, 50 * PERIOD_NS])
    robot.hardware.work_ns = lambda: next(work, 0)
    robot.loop.run()
    assert max(periods) == 5 * PERIOD_NS


def test_masks_show_which_controllers_are_active_and_which_publish(robot):
    def act(self, step, time_ns, _):
        if step == "update" and time_ns == PERIOD_NS:
            self.context.publish()

    robot.script("quiet", idle, active=False)
    robot.script("speaker", act, command=())
    run(robot, 3)
    assert [(cycle["active"], cycle["published"]) for cycle in robot.sink.cycles] == [(2, 0), (2, 2), (2, 0)]
    assert robot.events.of(EventCode.CONTROLLER_ACTIVATED) == [("speaker", "active")]
    assert robot.events.of(EventCode.CONTROLLER_DEACTIVATED) == [("speaker", "inactive")]


def test_the_duration_of_each_update_is_recorded(robot):
    def act(self, step, time_ns, _):
        if step == "update":
            robot.clock.wait_until(robot.clock.now_ns() + 700)

    robot.script("quick", idle, joints=("j0",))
    robot.script("thinker", act, joints=("j1",))
    run(robot, 1)
    np.testing.assert_array_equal(robot.record.controller_ns, [0, 700])


def test_a_type_without_a_plugin_is_named_with_the_broken_plugins(robot):
    robot.script("present", idle)
    robot._offers.clear()
    with pytest.raises(PlugInError, match=r"type present of controller present .*broken_one of x 1"):
        robot.build()


def test_parameters_that_do_not_fit_are_refused(robot):
    robot.add("strict", type(robot).scripted(), parameters='{"surplus": 1}')
    with pytest.raises(PlugInError, match=r"strict.* unknown key .surplus.; take it out"):
        robot.build()


def test_what_is_raised_while_configuring_becomes_one_sentence(robot):
    class Unready(type(robot).scripted()):
        def on_configure(self, context):
            raise OSError("no file")

    robot.add("unready", Unready)
    with pytest.raises(ControllerFault, match="controller unready raised in on_configure: OSError: no file"):
        robot.build()


def test_joints_of_a_faulty_controller_stop_where_the_gate_last_let_them(make_robot):
    robot = make_robot(velocity=1.0)

    def act(self, step, time_ns, _):
        if step == "update":
            self.context.commands.position[:] = 0.9
            assert time_ns < 2 * PERIOD_NS

    robot.script("failing", act)
    assert run(robot, 9).cycles == 3
    np.testing.assert_allclose([position[0] for position, _ in robot.hardware.written], [0.27, 0.29, 0.29])
    assert np.isnan(robot.sink.cycles[-1]["position"]).all()
