"""What only a loop with scripted servos shows of steering: exact and late cycles, the guardian, `on_hold`."""

import numpy as np
import pytest
from tests.kit.loops import PERIOD_NS, Robot, Scripted, commanding, plan_of

from dxlrun.channels.answers import Code
from dxlrun.channels.commands import LOOP
from dxlrun.channels.cycle import Torque
from dxlrun.channels.event_records import EventCode
from dxlrun.control.controllers.claims import claimed_modes, start_modes
from dxlrun.control.steering import PAUSED_CYCLE_NS
from dxlrun.errors import PlugInError
from dxlrun.plan.loop_plan import JointPlan
from dxlrun.plan.policy_plan import LIMP, PolicyPlan
from dxlwire.modes import Mode

LEFT = {"type": "left", "joints": ("j0",), "command": ("position", "velocity")}
OFF = {"active": False}
STRICT = PolicyPlan(of_features={"on_stale_command": LIMP})


class Left(Robot):
    """A robot with one controller of one joint."""

    def __init__(self, **left):
        super().__init__()
        self.script("left", commanding(position=0.1, velocity=1.0), joints=("j0",), **left)


@pytest.fixture
def left():
    return Left()


# Switches


def test_the_event_of_a_long_command_shows_only_its_begin(left):
    result = left.run(5, {2: [left.asks("pause"), left.loads("extra" * 30, **LEFT)]})
    assert (result.cycles, result.paused) == (5, 3)
    paused, text = left.events.texts(EventCode.STEERED)
    assert paused == "pause from anna"
    assert text.startswith("load extraextra")
    assert text.endswith(" ... from anna")
    assert len(text) < 150


def test_a_fallback_at_the_start_never_takes_a_joint_of_one_that_starts_after_it(robot):
    robot.script("weak", joints=("j0",), fallback="spare")
    robot.script("strong", joints=("j1",)).script("spare", joints=("j1",), **OFF)
    robot.breaks("weak", "activate")()
    assert robot.run(4).reason == "fault"
    assert robot.order("activate") == ["weak", "strong"]


def test_a_fallback_comes_after_all_whose_modes_came_in_its_cycle():
    """It claims a servo of another one that enters: that one has it."""
    robot, effort = Robot(joints=3), {"command": ("effort",), "active": False}
    robot.script("weak", joints=("j0",), fallback="greedy", **effort)
    robot.script("beside", joints=("j1",), **effort).script("greedy", **effort).build()
    robot.hardware.mode_cycles = lambda: 3
    robot.breaks("weak", "activate")()
    robot.run(12, {2: [robot.switches(["weak"]), robot.switches(["beside"])]})
    assert robot.answer()[0] is Code.CONTROLLER_FAULT
    assert robot.order("activate") == ["weak", "beside"]
    assert robot.result.reason == "fault"


def test_a_switch_that_waits_for_its_modes_is_refused_where_the_run_ends(robot):
    robot.script("pushes", joints=("j0",), command=("effort",), active=False).build()
    robot.hardware.mode_cycles = lambda: 30
    robot.run(4, {2: robot.switches(["pushes"])})
    assert robot.answer()[0] is Code.RUN_ENDING


@pytest.mark.parametrize("limp", [["j0"], ["j0", "j1"]])
def test_fallback_of_a_limp_joint_leaves_the_fault_to_the_next_fallback_or_to_the_policy(limp):
    robot = Robot(joints=3).script("lower", joints=("j2",), fallback="near", reference=("position",))
    robot.script("upper", joints=("j2",), command=("position",), into=("lower",), fallback="far")
    robot.script("near", joints=("j0",), **OFF).script("far", joints=("j1",), **OFF).build()
    for joint in limp:
        robot.record.states.torque[robot.names.index(joint)] = Torque.OFF
    robot.run(8, {3: robot.breaks("lower")})
    refused = [text.split(";")[0] for text in robot.events.texts(EventCode.COMMAND_REFUSED)]
    both = ["near cannot take over: j0 is limp", "far cannot take over: j1 is limp"]
    assert refused == both[: len(limp)]
    assert robot.result.reason == ("stopped" if len(limp) == 1 else "fault")


# Modes


def test_modes_follow_from_claims_and_the_rest_of_the_joints_rests():
    joints = (JointPlan("a", -1, 1, None), JointPlan("b", -1, 1, None, continuous=True))
    claims = [
        plan_of("x", joints=("a",), command=("effort",)),
        plan_of("y", joints=("b",), command=("pwm",), active=False),
        plan_of("z", joints=("a",), command=()),
    ]
    assert claimed_modes(claims) == {"a": Mode.EFFORT, "b": Mode.PWM}
    assert start_modes(joints, claims) == {"a": Mode.EFFORT, "b": Mode.VELOCITY}


# Pauses and rates


def test_the_guardian_waits_longer_in_a_pause_and_as_long_as_a_slow_loop_needs(left):
    rate = left.asks("rate", rate=100.0)
    left.run(5, {1: left.asks("pause"), 2: rate, 3: left.asks("resume")})
    assert left.patience == [PAUSED_CYCLE_NS, PAUSED_CYCLE_NS, PERIOD_NS // 2]
    slow = Left()
    slow.run(5, {1: slow.asks("rate", rate=1.0), 2: slow.asks("pause"), 3: slow.asks("resume")})
    assert slow.patience == [10**9] * 3


@pytest.mark.parametrize("resumed", [4, 2], ids=["in it", "as it ends"])
def test_a_late_cycle_in_a_pause_ends_no_run_and_costs_the_controllers_no_time(left, resumed):
    result = left.run(8, {1: left.asks("pause"), resumed: left.asks("resume")}, work={2: 3.5}, overrun="stop")
    assert (result.reason, result.skipped) == ("stopped", 3)
    times = left.times("left")
    assert np.diff(times).tolist() == [PERIOD_NS] * (len(times) - 1)


@pytest.mark.parametrize("length", [1, 2, 3])
def test_a_pause_does_not_change_the_period_of_a_slow_controller(length):
    left = Left(every=2)
    left.run(12, {3: left.asks("pause"), 3 + length: left.asks("resume")})
    assert {*np.diff(left.times("left"))} == {2 * PERIOD_NS}


def test_periods_are_skipped_in_a_pause_just_before_the_end_of_the_motions(left):
    left.run(99, {3: left.asks("pause"), 5: left.asks("resume")}, work={3: 5.5}, end_ns=5 * PERIOD_NS)
    assert left.result.reason == "ended"
    assert left.column("cycle") == [0, 1, 2, 3, 9, 10, 11]
    assert left.times("left") == [n * PERIOD_NS for n in range(5)]


@pytest.mark.parametrize("pause", range(1, 8))
def test_the_controllers_time_goes_on_when_a_loop_that_catches_up_is_paused(pause):
    for length in range(1, 6):
        left = Left()
        at = {pause: left.asks("pause"), pause + length: left.asks("resume")}
        left.run(20, at, work=dict.fromkeys(range(20), 1e-3) | {2: 5.25}, overrun="catch_up")
        assert (np.diff(left.times("left")) > 0).all()


def test_another_rate_begins_at_the_next_deadline_and_controllers_keep_theirs(left):
    left.script("right", joints=("j1",), every=2, rate=25.0)
    left.run(13, {4: left.asks("rate", rate=100.0)})
    assert np.diff(left.column("scheduled_ns")).tolist() == [PERIOD_NS] * 4 + [PERIOD_NS // 2] * 8
    assert np.diff(left.steps("right")).max() == 4
    assert [call.value for call in left.calls if call.name == "right"][-2] == 2 * PERIOD_NS
    assert left.patience == [PERIOD_NS // 2]


def test_a_stall_counts_as_five_periods_of_the_new_rate(left):
    left.script("slow", joints=("j1",), every=2, rate=25.0)
    left.run(13, {2: left.asks("rate", rate=100.0)}, work={5: 12.0})
    updates = [call for call in left.calls if call.step == "update"]
    assert max(call.value for call in updates if call.name == "left") == 5 * PERIOD_NS // 2
    assert max(call.value for call in updates if call.name == "slow") == 10 * PERIOD_NS


# Commands and streams


def test_a_flood_is_taken_in_small_portions(left):
    left.run(20, {1: [left.posts("left", "position", [0.5])] * 100})
    counts = left.column("command_count")
    assert (max(counts), sum(counts)) == (8, 100)
    first = left.taken[0]
    assert (first.cycle, first.planned, first.data) == (1, -1, np.array([0.5]).tobytes())


@pytest.mark.parametrize("policies", [PolicyPlan(), STRICT])
def test_a_stream_that_ends_is_reported_with_its_consequence(left, policies):
    left.run(15, {1: left.posts("left", "position", b"", 2 * PERIOD_NS)}, policies=policies)
    held = b"false" if policies is STRICT else b"true"
    assert left.events.data_of(EventCode.STALE_COMMAND) == [b'{"held":' + held + b"}"]
    assert len(left.steps("left")) == (5 if policies is STRICT else 15), "a held one is updated all the same"


def test_commands_of_a_stream_that_ended_stay_withheld_when_a_joint_regains_torque(left):
    def shows(torque):
        return lambda: left.record.states.torque.__setitem__(0, torque)

    stream, command = left.posts("left", "position", b"", PERIOD_NS), left.posts("left", "position")
    left.run(15, {1: stream, 6: shows(Torque.GIVEN), 7: shows(Torque.ON), 11: command})
    assert left.steps("left", "activate") == [-1, 6, 11]
    sent = left.column("position", 0)
    assert np.isnan(sent[3:11]).all()
    assert sent[11:] == [0.1] * 4


def test_a_motion_file_ends_a_stream(left):
    left.send(2 * PERIOD_NS, "left", "position", 0.5)
    result = left.run(9, {1: left.posts("left", "position", b"", 3 * PERIOD_NS)}, policies=STRICT)
    assert (result.reason, left.events.of(EventCode.STALE_COMMAND)) == ("stopped", [])


# Loading


def test_an_inactive_controller_of_a_lost_joint_takes_no_command_from_an_active_one(robot):
    robot.script("right", commanding(position=0.1), joints=("j1",), command=("position",), every=5)
    robot.script("whole", **OFF)
    robot.run(10, {7: lambda: robot.manager.hold_lost({0}, "all its joints answer again")})
    assert robot.column("position", 1) == [0.1] * 10


def test_a_controller_that_is_loaded_while_its_servo_is_lost_is_held(left):
    manager = left.build().manager
    manager.hold_lost({0}, "all its joints answer again")
    for name, joint in (("extra", "j0"), ("other", "j1")):
        assert isinstance(manager.load_controller(plan_of(name, type="left", joints=(joint,))), int)
    assert [manager._named[name].held for name in ("extra", "other")] == [True, False]


def test_a_controller_that_is_loaded_anew_after_its_failure_may_stand_in_again():
    robot = Left(fallback="extra")
    manager, extra = robot.build().manager, plan_of("extra", fallback="left", **LEFT)
    assert manager.load_controller(extra) == 1
    assert manager.switching.switch_controllers(("extra",), ()) is None
    for failed, stands_in in (("extra", "left"), ("left", "extra")):
        robot.breaks(failed)()
        manager.update(0)
        assert manager.active == (stands_in,)
        if stands_in == "left":
            assert manager.unload_controller("extra") is None
            assert manager.load_controller(extra) == 1
    assert manager.switching.fault is None


def test_a_failure_does_not_count_for_a_later_controller_of_the_same_name():
    robot = Left(fallback="x")
    load = [robot.asks("pause"), robot.loads("x", active=False, **LEFT)]
    robot.run(4, {0: load, 1: robot.asks("resume"), 2: robot.breaks("left")})
    assert robot.refusals == {1: "", 2: "", 3: ""}
    assert robot.active(3) == ["x"]


def test_places_of_unloaded_controllers_are_used_again_under_whatever_name(left):
    names = "abbc"
    load = {name: left.loads(name, **LEFT) for name in names}
    unload = {name: left.asks("unload", controller=name) for name in names}
    steps = [load["a"], load["b"], unload["a"], unload["b"], load["b"], load["c"]]
    many = {cycle: [load["a"], unload["a"]] for cycle in range(10, 110)}
    at = {1: [left.asks("pause"), *steps], 2: left.switches(["c"], ["left"])}
    left.run(115, at | many)
    assert set(left.refusals.values()) == {""}
    assert left.column("active")[2:4] == [0b100] * 2


def test_a_controller_is_loaded_with_the_period_that_the_loop_has_now(left):
    left.run(
        4, {1: [left.asks("rate", rate=100.0), left.asks("pause")], 2: left.loads("extra", rate=25.0, **LEFT)}
    )
    assert left.manager._named["extra"].controller.context.period_ns == 40_000_000


class Unbuilt(Scripted):
    def __init__(self, parameters):
        raise KeyError("no such calibration")


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"type": "unbuilt"}, "no such calibration"),
        (b'{"unknown": ' + b"[" * 100_000 + b"]" * 100_000 + b"}", ""),
    ],
    ids=["class that raises", "deeper than Python goes"],
)
def test_what_cannot_be_loaded_is_refused(left, options, why):
    left.add("unbuilt", Unbuilt, joints=("j0",), active=False)._controllers.pop()
    raw = isinstance(options, bytes)
    load = left.posts(LOOP, "load", options) if raw else left.loads("x", **LEFT | options)
    assert left.run(4, {1: [left.asks("pause"), load]}).reason == "stopped"
    assert left.refusals[2]
    assert why in left.refusals[2]


def test_a_controller_that_starts_a_thread_while_it_is_configured_is_refused(left):
    asked = []

    def count(name):
        asked.append(name)
        raise PlugInError(f"plug-in {name} started 1 more thread")

    left.build().after_each = count
    assert left.run(4, {1: [left.asks("pause"), left.loads("x", **LEFT)]}).reason == "stopped"
    assert "1 more thread" in left.refusals[2]
    assert asked == ["of controller x"]


def test_each_load_has_the_guardians_timeout_for_itself(left):
    loads = [left.loads(name, **LEFT) for name in "xy"]
    result = left.run(5, {1: left.asks("pause"), 2: [*loads, left.asks("resume")]})
    assert left.beats >= result.cycles + 2
