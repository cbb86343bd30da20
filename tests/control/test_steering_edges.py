"""Steering where several things meet: pauses, rates, ends, streams and faults in the same few cycles."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from dxlrun.channels.commands import LOOP
from dxlrun.channels.events import EventCode
from dxlrun.control.loop import PAUSED_CYCLE_NS
from dxlrun.errors import PlugInError
from dxlrun.plan.loop_plan import ControllerPlan
from dxlrun.plan.policy_plan import LIMP, PolicyPlan

PERIOD_NS = 20_000_000


class Steered:
    """A robot whose controllers write down what they see; `at` maps a cycle's place to what is asked."""

    def __init__(self, make_robot, joints=2):
        self.robot = make_robot(joints=joints)
        self.seen = []
        self.at = {}
        self.failing = set()
        self.beats = []

    def add(self, name, **options):
        def act(controller, step, time_ns, value):
            self.seen.append((self.robot.loop.record.cycle, name, step, time_ns, value))
            if (name, step) in self.failing:
                raise RuntimeError("lost its way")
            if step == "update":
                controller.context.commands.position[:] = 0.1
                controller.context.commands.velocity[:] = 1.0

        self.robot.script(name, act, **options)

    def run(self, cycles, work=None, **plan):
        """Run so many cycles; `work` maps a cycle's place to how many periods it takes."""
        robot = self.robot
        robot.build(**plan)
        robot.hardware.keep = False
        robot.hardware.work_ns = lambda: int((work or {}).get(len(robot.sink.cycles), 0) * PERIOD_NS)

        def idle(deadline_ns):
            number = len(robot.sink.cycles)
            for act in self.at.get(number, ()):
                act()
            if number == cycles - 1:
                robot.stop.request()

        robot.hardware.idle = idle
        return robot.loop.run()

    def times(self, name):
        return [time_ns for _, who, step, time_ns, _ in self.seen if (who, step) == (name, "update")]

    def cycles(self):
        return [cycle["cycle"] for cycle in self.robot.sink.cycles]


@pytest.fixture
def steered(make_robot):
    return Steered(make_robot)


def plan_of(name, kind, **changes):
    plan = ControllerPlan(
        name=name,
        type=kind,
        distribution="tests 1",
        parameters="{}",
        joints=("j0",),
        command=("position", "velocity"),
        publishes=(),
        active=False,
        every=1,
    )
    return msgspec.to_builtins(plan) | changes


# Claims, when a fault comes into a switch


def test_a_fallback_never_takes_a_joint_that_the_same_switch_gives_to_another(steered):
    robot = steered.robot
    steered.add("idle", joints=("j0",))
    steered.add("weak", joints=("j0",), active=False, fallback="spare")
    steered.add("strong", joints=("j1",), active=False)
    steered.add("spare", joints=("j1",), active=False)
    steered.failing.add(("weak", "activate"))
    steered.at[1] = [lambda: robot.ask("switch", activate=["weak", "strong"], deactivate=["idle"])]
    result = steered.run(4)
    assert result.reason == "fault"
    assert "spare" not in [name for _, name, _, _, _ in steered.seen]


def test_a_fallback_that_starts_with_the_run_does_not_take_the_joints_of_a_later_controller(steered):
    steered.add("weak", joints=("j0",), fallback="spare")
    steered.add("strong", joints=("j1",))
    steered.add("spare", joints=("j1",), active=False)
    steered.failing.add(("weak", "activate"))
    assert steered.run(3).reason == "fault"
    assert "spare" not in [name for _, name, _, _, _ in steered.seen]


def test_a_fallback_that_the_switch_activates_anyway_begins_once(steered):
    robot = steered.robot
    steered.add("weak", joints=("j0",), active=False, fallback="spare")
    steered.add("spare", joints=("j1",), active=False)
    steered.failing.add(("weak", "activate"))
    steered.at[1] = [lambda: robot.ask("switch", activate=["weak", "spare"])]
    steered.run(4)
    assert [step for _, name, step, _, _ in steered.seen if name == "spare"].count("activate") == 1


# What is loaded


@pytest.mark.parametrize("rate", [0.0, -1.0, 1e-320])
def test_a_rate_that_is_none_is_refused_with_the_controller(steered, rate):
    robot = steered.robot
    steered.add("left", joints=("j0",))
    steered.at[1] = [lambda: robot.ask("pause"), lambda: robot.ask("load", **plan_of("x", "left", rate=rate))]
    assert steered.run(4).reason == "stopped"
    assert "rate" in robot.refusals[2]


def test_data_nested_deeper_than_python_goes_is_refused(steered):
    robot = steered.robot
    steered.add("left", joints=("j0",))
    deep = b'{"unknown": ' + b"[" * 100_000 + b"]" * 100_000 + b"}"
    steered.at[1] = [lambda: robot.ask("pause"), lambda: robot.post(LOOP, "load", deep)]
    assert steered.run(4).reason == "stopped"
    assert robot.refusals[2]


def test_a_controller_that_cannot_even_be_built_is_refused(steered):
    robot = steered.robot

    class Unbuilt(robot.scripted()):
        def __init__(self, parameters):
            raise KeyError("no such calibration")

    steered.add("left", joints=("j0",))
    robot.add("unbuilt", Unbuilt, joints=("j0",), active=False)
    controllers = robot._controllers
    controllers.remove(controllers[-1])  # its type is offered, and no plan asks for it
    steered.at[1] = [lambda: robot.ask("pause"), lambda: robot.ask("load", **plan_of("x", "unbuilt"))]
    assert steered.run(4).reason == "stopped"
    assert "no such calibration" in robot.refusals[2]


def test_each_load_has_the_guardians_timeout_for_itself(steered):
    robot = steered.robot
    steered.add("left", joints=("j0",))
    steered.at[1] = [lambda: robot.ask("pause")]
    steered.at[2] = [
        lambda: robot.ask("load", **plan_of("x", "left")),
        lambda: robot.ask("load", **plan_of("y", "left")),
        lambda: robot.ask("resume"),
    ]
    result = steered.run(5)
    assert robot.beats >= result.cycles + 2


# Patience


def test_a_pause_of_a_slow_loop_leaves_it_its_period(make_robot):
    steered = Steered(make_robot)
    robot = steered.robot
    steered.add("left", joints=("j0",))
    steered.at = {
        1: [lambda: robot.ask("rate", rate=1.0)],
        2: [lambda: robot.ask("pause")],
        3: [lambda: robot.ask("resume")],
    }
    steered.run(5)
    assert robot.patience == [10**9, 10**9, 10**9]


def test_another_rate_in_a_pause_leaves_the_timeout_of_the_pause(steered):
    robot = steered.robot
    steered.add("left", joints=("j0",))
    steered.at = {
        1: [lambda: robot.ask("pause")],
        2: [lambda: robot.ask("rate", rate=100.0)],
        3: [lambda: robot.ask("resume")],
    }
    steered.run(5)
    assert robot.patience == [PAUSED_CYCLE_NS, PAUSED_CYCLE_NS, PERIOD_NS // 2]


@pytest.mark.parametrize("rate", [1e-320, 1e-300, 1e-9, 0.1])
def test_a_rate_at_which_a_stop_would_be_seen_too_late_is_refused(steered, rate):
    robot = steered.robot
    steered.add("left", joints=("j0",))
    steered.at[1] = [lambda: robot.ask("rate", rate=rate)]
    assert steered.run(4, policies=PolicyPlan()).reason == "stopped"
    assert "Hz" in robot.refusals[1]


# Time


def test_a_late_cycle_in_a_pause_ends_no_run_and_calls_no_hook(steered):
    robot = steered.robot
    steered.add("left", joints=("j0",))
    steered.at = {1: [lambda: robot.ask("pause")], 4: [lambda: robot.ask("resume")]}
    result = steered.run(8, work={2: 3.5}, overrun="stop")
    assert (result.reason, result.skipped) == ("stopped", 3)
    assert np.diff(steered.times("left")).tolist() == [PERIOD_NS] * (len(steered.times("left")) - 1)


def test_a_load_and_a_resume_in_one_cycle_cost_the_controllers_no_time(steered):
    robot = steered.robot
    steered.add("left", joints=("j0",))
    steered.at = {1: [lambda: robot.ask("pause")], 2: [lambda: robot.ask("resume")]}
    result = steered.run(8, work={2: 3.5}, overrun="stop")
    assert (result.reason, result.skipped) == ("stopped", 3)
    assert np.diff(steered.times("left")).tolist() == [PERIOD_NS] * (len(steered.times("left")) - 1)


def test_periods_are_skipped_in_a_pause_just_before_the_end_of_the_motions(steered):
    robot = steered.robot
    steered.add("left", joints=("j0",))
    steered.at = {3: [lambda: robot.ask("pause")], 5: [lambda: robot.ask("resume")]}
    result = steered.run(99, work={3: 5.5}, end_ns=5 * PERIOD_NS)
    assert result.reason == "ended"
    assert steered.cycles() == [0, 1, 2, 3, 9, 10, 11]
    assert steered.times("left") == [n * PERIOD_NS for n in range(5)]


@pytest.mark.parametrize("pause", range(1, 8))
@pytest.mark.parametrize("length", range(1, 6))
def test_the_controllers_time_never_goes_back_when_a_loop_that_catches_up_is_paused(steered, pause, length):
    robot = steered.robot
    steered.add("left", joints=("j0",))
    steered.at = {
        pause: [lambda: robot.ask("pause")],
        pause + length: [lambda: robot.ask("resume")],
    }
    steered.run(20, work={2: 5.25}, overrun="catch_up")
    assert (np.diff(steered.times("left")) >= 0).all()


# Streams


def leased(robot, name, cycles):
    return lambda: robot.post(name, "position", b"", cycles * PERIOD_NS)


STRICT = PolicyPlan(on_stale_command=LIMP)


@pytest.mark.parametrize("policies", [PolicyPlan(), STRICT])
def test_a_pause_ends_by_policy_when_its_client_has_left(steered, monkeypatch, policies):
    monkeypatch.setattr("dxlrun.control.loop.PAUSE_LEASE_NS", 5 * PERIOD_NS)
    robot = steered.robot
    steered.add("left", joints=("j0",))
    steered.at = {
        2: [lambda: robot.ask("pause")],
        5: [lambda: robot.ask("rate", rate=50.0)],  # of a client that is there
        7: [lambda: robot.post("left", "position")],  # of another one
    }
    result = steered.run(20, policies=policies)
    ((source, text),) = robot.events.of(EventCode.STALE_COMMAND)
    seen = [cycle for cycle, name, step, *_ in steered.seen if (name, step) == ("left", "update")]
    if policies is STRICT:
        assert result.reason == "fault"
        assert "no client ended the pause; on_stale_command: limp" in result.detail
        assert (source, text) == ("loop", "no client ended the pause; the run ends: limp")
        assert steered.cycles()[-1] == 11
    else:
        assert result.reason == "stopped"
        assert text.endswith("its controllers are deactivated, and the joints are held")
        assert (seen, steered.cycles()[-1]) == ([0, 1], 19)
        assert robot.loop.paused is False


def test_a_stream_of_a_controller_that_was_taken_out_ends_nothing(steered):
    robot = steered.robot
    steered.add("left", joints=("j0",))
    steered.at = {
        1: [leased(robot, "left", 3)],
        2: [lambda: robot.ask("switch", deactivate=["left"])],
    }
    assert steered.run(9, policies=STRICT).reason == "stopped"
    assert robot.events.of(EventCode.STALE_COMMAND) == []


def test_a_controller_that_began_anew_has_nothing_of_the_stream_before(steered):
    robot = steered.robot
    steered.add("left", joints=("j0",))
    steered.at = {
        1: [leased(robot, "left", 3)],
        2: [lambda: robot.ask("switch", activate=["left"], deactivate=["left"])],
    }
    assert steered.run(9, policies=STRICT).reason == "stopped"
    assert len(steered.times("left")) == 9


def test_a_command_of_the_motion_file_ends_the_lease_of_a_stream_before_it(steered):
    robot = steered.robot
    steered.add("left", joints=("j0",))
    robot.send(3 * PERIOD_NS, "left", "position", 0.5)
    steered.at = {1: [leased(robot, "left", 4)]}
    assert steered.run(9, policies=STRICT).reason == "stopped"
    assert len(steered.times("left")) == 9


def test_a_controller_that_starts_a_thread_while_it_is_configured_is_refused(steered):
    robot = steered.robot
    asked = []

    def count(name):
        asked.append(name)
        if name == "of controller x":
            raise PlugInError(f"plug-in {name} started 1 more thread")

    steered.add("left", joints=("j0",))
    steered.at[1] = [lambda: robot.ask("pause"), lambda: robot.ask("load", **plan_of("x", "left"))]
    build = robot.build

    def watched_build(**plan):
        build(**plan)
        robot.manager._plugins = replace(robot.manager._plugins, after_each=count)

    robot.build = watched_build
    assert steered.run(4).reason == "stopped"
    assert "1 more thread" in robot.refusals[2]
    assert asked == ["of controller x"]


def test_a_failure_does_not_count_for_a_later_controller_of_the_same_name(steered):
    robot = steered.robot
    steered.add("left", joints=("j0",), fallback="x")
    steered.add("right", joints=("j1",), active=False)
    steered.failing.add(("right", "activate"))
    steered.at = {
        0: [lambda: robot.ask("pause"), lambda: robot.ask("load", **plan_of("x", "left"))],
        1: [lambda: robot.ask("resume")],
        2: [lambda: steered.failing.add(("left", "update"))],
    }
    steered.run(4)
    assert robot.refusals == {1: "", 2: "", 3: ""}
