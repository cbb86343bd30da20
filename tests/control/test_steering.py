"""A loop that is steered: what is done in which cycle, what is refused and why, and what never happens."""

import numpy as np
import pytest
from tests.kit.loops import PERIOD_NS, Robot, Scripted, commanding, on_update, plan_of

from dxlrun.channels.answers import Code, Completion
from dxlrun.channels.commands import LOOP
from dxlrun.channels.cycle import Torque
from dxlrun.channels.event_records import EventCode
from dxlrun.control.steering import PAUSED_CYCLE_NS
from dxlrun.errors import PlugInError
from dxlrun.plan.policy_plan import LIMP, SLOW_SPEED, PolicyPlan

BOTH = ("position", "velocity")
LEFT = {"type": "left", "joints": ("j0",), "command": BOTH}
"""Options of a controller of left's type that is loaded."""


class Steered(Robot):
    """A robot with two arms' controllers and one for the whole body."""

    def __init__(self, **right):
        super().__init__()
        moves = commanding(position=0.1, velocity=1.0)
        self.script("left", moves, joints=("j0",)).script("right", moves, joints=("j1",), **right)
        self.script("whole", moves, active=False)


class Left(Robot):
    """A robot with one controller of one joint."""

    def __init__(self, **left):
        super().__init__()
        self.script("left", commanding(position=0.1, velocity=1.0), joints=("j0",), **left)


@pytest.fixture
def steered():
    return Steered()


@pytest.fixture
def left():
    return Left()


# Switches


def test_a_switch_happens_in_one_cycle_or_not_at_all(steered):
    steered.run(6, {3: steered.switches(["whole"], ["left", "right"])})
    assert steered.column("active") == [0b011] * 3 + [0b100] * 3
    assert steered.steps("left") == [0, 1, 2]
    assert steered.steps("whole") == [3, 4, 5]
    assert steered.steps("left", "deactivate") == steered.steps("whole", "activate") == [3]
    assert steered.answer() == Completion(3)
    assert steered.events.texts(EventCode.STEERED)[0].endswith("from anna")


def test_the_event_of_a_long_command_shows_only_its_begin(steered):
    steered.run(5, {2: [steered.asks("pause"), steered.loads("extra" * 30, **LEFT)]})
    paused, text = steered.events.texts(EventCode.STEERED)
    assert paused == "pause from anna"
    assert text.startswith("load extraextra")
    assert text.endswith(" ... from anna")
    assert len(text) < 150


@pytest.mark.parametrize(
    ("switch", "code", "why"),
    [
        (
            {"activate": ["whole"], "deactivate": ["left"]},
            Code.JOINTS_CLAIMED,
            "right and whole both command joint j1; deactivate",
        ),
        ({"activate": ["whole", "left"]}, Code.ACTIVE_ALREADY, "left is active already"),
        ({"activate": ["nun"], "deactivate": ["no"]}, Code.UNKNOWN_CONTROLLER, "no controller nun, no"),
        ({"deactivate": ["whole"]}, Code.INACTIVE_ALREADY, "whole is not active"),
        ({"deactivate": ["left", "left"]}, Code.NAMED_TWICE, "left is named twice"),
        ({"activte": ["whole"]}, Code.INVALID, "activte"),
        (b'{"activate": ["\xff"]}', Code.INVALID, ""),
    ],
)
def test_a_switch_that_cannot_be_is_refused_whole(steered, switch, code, why):
    bytes_ = isinstance(switch, bytes)
    asked = steered.posts(LOOP, "switch", switch) if bytes_ else steered.asks("switch", **switch)
    steered.run(5, {2: asked})
    assert why in steered.refusals[1]
    assert steered.answer()[0] is code
    assert steered.column("active") == [0b011] * 5
    assert why in steered.events.texts(EventCode.COMMAND_REFUSED)[0]


def test_a_controller_in_both_lists_begins_anew(steered):
    steered.run(4, {2: steered.switches(["left"], ["left"])})
    assert steered.steps("left", "activate") == [-1, 2]
    assert steered.steps("left") == [0, 1, 2, 3]


@pytest.mark.parametrize("at_start", [True, False])
def test_a_fallback_never_takes_a_joint_that_is_given_to_another(robot, at_start):
    robot.script("idle", joints=("j0",), active=not at_start)
    robot.script("weak", joints=("j0",), active=at_start, fallback="spare")
    robot.script("strong", joints=("j1",), active=at_start).script("spare", joints=("j1",), active=False)
    robot.breaks("weak", "activate")()
    robot.run(4, {} if at_start else {1: robot.switches(["weak", "strong"], ["idle"])})
    assert robot.result.reason == "fault"
    assert "spare" not in robot.order("activate")


def test_a_fallback_that_the_switch_activates_anyway_begins_once(robot):
    robot.script("weak", joints=("j0",), active=False, fallback="spare")
    robot.script("spare", joints=("j1",), active=False).breaks("weak", "activate")()
    robot.run(4, {1: robot.switches(["weak", "spare"])})
    assert robot.order("activate").count("spare") == 1


def test_a_fallback_takes_over_in_the_cycle_of_the_fault():
    robot = Left(fallback="careful").script("careful", joints=("j0",), active=False)
    assert robot.run(6, {3: robot.breaks("left")}).reason == "stopped"
    assert [robot.active(cycle) for cycle in (2, 3)] == [["left"], ["careful"]]
    assert robot.steps("careful") == [3, 4, 5]


# Pauses


def test_in_a_pause_time_stands_still_and_servos_are_held(steered):
    steered.run(10, {3: steered.asks("pause"), 7: steered.asks("resume")})
    assert steered.steps("left") == [0, 1, 2, 7, 8, 9]
    assert steered.times("left") == [turn * PERIOD_NS for turn in range(6)]
    assert {call.value for call in steered.calls if call.step == "update"} == {PERIOD_NS}
    assert steered.column("cycle") == list(range(10))
    assert np.isnan(steered.column("position", 0)[3:7]).all()


def test_after_a_pause_goals_that_moved_away_are_approached_slowly():
    robot, wanted = Robot(joints=1), [0.1]
    robot.script("arm", on_update(lambda context, *_: context.commands.position.fill(wanted[-1])))
    # the slow second after the start is over
    robot.run(76, {60: robot.asks("pause"), 65: lambda: wanted.append(-0.9), 70: robot.asks("resume")})
    goals = [position[0] for position, _ in robot.hardware.written]
    assert goals[59] == goals[69] == 0.1
    assert goals[70:73] == pytest.approx([0.1 - SLOW_SPEED * 0.02 * step for step in (1, 2, 3)])


@pytest.mark.parametrize("kind", ["pause", "resume"])
def test_what_is_so_already_is_refused(steered, kind):
    steered.run(4, {1: steered.asks("pause") if kind == "pause" else (), 2: steered.asks(kind)})
    assert max(steered.refusals.items())[1].startswith("the loop is ")


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


def test_periods_are_skipped_in_a_pause_just_before_the_end_of_the_motions(left):
    left.run(99, {3: left.asks("pause"), 5: left.asks("resume")}, work={3: 5.5}, end_ns=5 * PERIOD_NS)
    assert left.result.reason == "ended"
    assert left.column("cycle") == [0, 1, 2, 3, 9, 10, 11]
    assert left.times("left") == [n * PERIOD_NS for n in range(5)]


@pytest.mark.parametrize("pause", range(1, 8))
@pytest.mark.parametrize("length", range(1, 6))
def test_the_controllers_time_never_goes_back_when_a_loop_that_catches_up_is_paused(left, pause, length):
    at = {pause: left.asks("pause"), pause + length: left.asks("resume")}
    left.run(20, at, work={2: 5.25}, overrun="catch_up")
    assert (np.diff(left.times("left")) >= 0).all()


STRICT = PolicyPlan(of_features={"on_stale_command": LIMP})


@pytest.mark.parametrize("policies", [PolicyPlan(), STRICT])
def test_a_pause_ends_by_policy_when_its_client_has_left(left, monkeypatch, policies):
    monkeypatch.setattr("dxlrun.control.steering.PAUSE_LEASE_NS", 5 * PERIOD_NS)
    there, other = left.asks("rate", rate=50.0), left.posts("left", "position")
    result = left.run(20, {2: left.asks("pause"), 5: there, 7: other}, policies=policies)
    ((source, text),) = left.events.of(EventCode.STALE_COMMAND)
    if policies is STRICT:
        assert result.reason == "fault"
        assert "no client ended the pause; on_stale_command: limp" in result.detail
        assert (source, text) == ("loop", "no client ended the pause; the run ends: limp")
        assert left.column("cycle")[-1] == 11
    else:
        assert result.reason == "stopped"
        assert text.endswith("its controllers are deactivated, and the joints are held")
        assert (left.steps("left"), left.column("cycle")[-1]) == ([0, 1], 19)
        assert left.loop.steering.paused is False


# Rates


def test_another_rate_begins_at_the_next_deadline_and_controllers_keep_theirs():
    robot = Steered(every=2, rate=25.0)
    robot.run(13, {4: robot.asks("rate", rate=100.0)})
    assert np.diff(robot.column("scheduled_ns")).tolist() == [PERIOD_NS] * 4 + [PERIOD_NS // 2] * 8
    assert np.diff(robot.steps("right")).max() == 4
    assert [call.value for call in robot.calls if call.name == "right"][-2] == 2 * PERIOD_NS
    assert robot.patience == [PERIOD_NS // 2]


@pytest.mark.parametrize(
    ("rate", "code", "why"),
    [
        (60.0, Code.RATE_NOT_DIVIDED, "60 Hz is not a multiple of 25 Hz, the rate of controller right"),
        (500.0, Code.RATE_OVER_BUSES, "at most 200 Hz"),
        *(
            (rate, Code.RATE_OUT_OF_RANGE, "not a possible rate")
            for rate in (0.1, 1e-3, 1e-300, 1e-320, 0.0, -3.0)
        ),
    ],
)
def test_a_rate_that_cannot_be_is_refused(rate, code, why):
    robot = Steered(every=2, rate=25.0)
    robot.run(4, {1: robot.asks("rate", rate=rate)}, least_period_ns=5_000_000)
    assert why in robot.refusals[1]
    assert robot.answer()[0] is code
    assert set(np.diff(robot.column("scheduled_ns")).tolist()) == {PERIOD_NS}


# Commands and streams


def test_a_command_reaches_its_controller_and_the_log(steered):
    steered.run(4, {2: steered.posts("left", "position", [0.5])})
    assert steered.steps("left", "command") == [2]
    taken = [(one.cycle, one.planned, one.controller, one.data) for one in steered.taken]
    assert taken == [(2, -1, "left", np.array([0.5]).tobytes())]
    assert steered.column("command_count") == [0, 0, 1, 0]


@pytest.mark.parametrize(
    ("name", "data", "why"),
    [
        ("whole", b"", (Code.NOT_ACTIVE, {"controller": "whole"})),
        ("nun", b"", (Code.UNKNOWN_CONTROLLER, {"controller": "nun"})),
        ("left", b"abc", (Code.INVALID, {"problem": "3 bytes are not an array of numbers"})),
    ],
)
def test_a_command_that_cannot_be_is_refused(steered, name, data, why):
    steered.run(3, {1: steered.posts(name, "position", data)})
    assert steered.answer() == why
    assert not steered.steps(name, "command")


def test_a_flood_is_taken_in_small_portions(steered):
    steered.run(20, {1: [steered.posts("left", "position")] * 100})
    counts = steered.column("command_count")
    assert (max(counts), sum(counts)) == (8, 100)


def test_a_run_ends_when_it_is_asked_to(steered):
    result = steered.run(100, {4: steered.asks("stop")})
    assert (result.reason, result.cycles) == ("stopped", 5)


def test_a_stream_that_ends_without_a_word_is_held_until_the_next_command(steered):
    stream = steered.posts("left", "position", b"", 2 * PERIOD_NS)
    steered.run(15, {1: stream, 2: stream, 3: stream, 9: steered.posts("left", "position")})
    assert steered.steps("left") == list(range(15)), "it is updated all the same"
    again = [call.cycle for call in steered.calls if (call.name, call.step) == ("left", "activate")]
    assert again == [-1, 9], "its commands are of another time"
    held = ("left", "the stream of commands ended; its joints are held")
    assert steered.events.of(EventCode.STALE_COMMAND) == [held]
    assert steered.events.data_of(EventCode.STALE_COMMAND) == [b'{"held":true}']
    assert np.isnan(steered.sink.cycles[7]["position"]).tolist() == [True, False]
    assert steered.active(7) == ["left", "right"]


def test_a_stream_that_ends_the_run_by_its_policy_is_not_reported_as_held(steered):
    steered.run(15, {1: steered.posts("left", "position", b"", 2 * PERIOD_NS)}, policies=STRICT)
    (data,) = steered.events.data_of(EventCode.STALE_COMMAND)
    assert data == b'{"held":false}'


def test_commands_of_a_stream_that_ended_stay_withheld_when_a_joint_regains_torque(steered):
    def shows(torque):
        return lambda: steered.record.states.torque.__setitem__(0, torque)

    stream, command = steered.posts("left", "position", b"", PERIOD_NS), steered.posts("left", "position")
    steered.run(15, {1: stream, 6: shows(Torque.GIVEN), 7: shows(Torque.ON), 11: command})
    assert steered.steps("left", "activate") == [-1, 6, 11]
    sent = [cycle["position"][0] for cycle in steered.sink.cycles]
    assert np.isnan(sent[3:11]).all()
    assert sent[11:] == [0.1] * 4


class Holding(Scripted):
    """Holds by commands of its own when its stream ends."""

    def on_hold(self, time_ns):
        self.act("hold", time_ns, self.context.commands.position.copy())


def hold_at(self, step, time_ns, value):
    if step != "activate":
        self.context.commands.position[:] = 0.5 if step == "hold" else self.context.commands.position
    if step == "command":
        self.context.commands.position[:] = 0.1


def test_a_controller_holds_by_commands_of_its_own():
    robot = Robot()
    seen = []

    def act(self, step, time_ns, value):
        seen.append((step, robot.record.cycle))
        if step == "hold":
            assert np.isnan(value).all(), "it begins without commands"
        hold_at(self, step, time_ns, value)

    robot.add("left", type("OneHolding", (Holding,), {"act": act}))
    robot.run(8, {1: robot.posts("left", "position", b"", PERIOD_NS), 6: robot.posts("left", "position")})
    assert [cycle for step, cycle in seen if step == "hold"] == [3]
    assert [cycle for step, cycle in seen if step == "activate"] == [-1], "its commands were not withheld"
    assert [one["position"][0] for one in robot.sink.cycles[1:]] == [0.1] * 2 + [0.5] * 3 + [0.1] * 2


def test_a_controller_that_breaks_its_contract_when_it_is_to_hold_is_ended():
    robot = Robot()

    def act(self, step, time_ns, value):
        hold_at(self, step, time_ns, value)
        if step == "hold":
            raise RuntimeError("broken")

    robot.add("left", type("OneHolding", (Holding,), {"act": act}))
    result = robot.run(8, {1: robot.posts("left", "position", b"", PERIOD_NS)})
    assert (result.reason, result.cycles) == ("fault", 4)
    assert "raised in on_hold: RuntimeError: broken" in result.detail
    assert np.isnan(robot.sink.cycles[3]["position"]).all()


@pytest.mark.parametrize("happens", ["taken out", "began anew", "commanded by the motion file", "nothing"])
def test_a_stream_that_was_ended_ends_no_run(left, happens):
    stream = left.posts("left", "position", b"", 3 * PERIOD_NS)
    then = {
        "taken out": {2: left.switches((), ["left"])},
        "began anew": {2: left.switches(["left"], ["left"])},
    }
    if happens == "commanded by the motion file":
        left.send(2 * PERIOD_NS, "left", "position", 0.5)
    result = left.run(9, {1: stream} | then.get(happens, {}), policies=STRICT)
    stale = happens == "nothing"
    assert result.reason == ("fault" if stale else "stopped")
    assert len(left.events.of(EventCode.STALE_COMMAND)) == stale
    assert len(left.times("left")) == {"taken out": 2, "nothing": 6}.get(happens, 9)


# Loading


def test_a_controller_is_loaded_and_unloaded_in_a_pause_only(steered):
    ask = steered.asks
    load, unload = steered.loads("extra", **LEFT), ask("unload", controller="extra")
    at = {
        1: load,
        2: [ask("pause"), load],
        3: [ask("resume"), steered.switches(["extra"], ["left"])],
        4: unload,
        5: [ask("pause"), unload],
        6: steered.switches(["left"], ["extra"]),
        7: [unload, ask("resume")],
    }
    steered.run(10, at)
    assert {number: text for number, text in steered.refusals.items() if text} == {
        1: "the loop is not paused; pause it first",
        6: "the loop is not paused; pause it first",
        8: "extra is active; deactivate it first",
    }
    assert steered.column("active")[3:6] == [0b1010] * 3
    assert len(steered.events.of(EventCode.CONTROLLER_LOADED)) == 2


def test_a_controller_that_is_loaded_while_its_servo_is_lost_is_held(steered):
    manager = steered.build().manager
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


def test_places_of_unloaded_controllers_are_used_again_under_whatever_name(steered):
    names = "abbc"
    load = {name: steered.loads(name, **LEFT) for name in names}
    unload = {name: steered.asks("unload", controller=name) for name in names}
    steps = [load["a"], load["b"], unload["a"], unload["b"], load["b"], load["c"]]
    many = {cycle: [load["a"], unload["a"]] for cycle in range(10, 110)}
    at = {1: [steered.asks("pause"), *steps], 2: steered.switches(["c"], ["left"])}
    steered.run(115, at | many)
    assert set(steered.refusals.values()) == {""}
    assert steered.column("active")[2:4] == [0b010010] * 2


def test_a_controller_is_loaded_with_the_period_that_the_loop_has_now(steered):
    loads = [steered.loads("extra", rate=rate, **LEFT) for rate in (30.0, 25.0)]
    steered.run(4, {1: [steered.asks("rate", rate=100.0), steered.asks("pause")], 2: loads})
    refused = "100 Hz is not a multiple of 30 Hz, the rate of controller extra"
    assert steered.refusals == {1: "", 2: "", 3: refused, 4: ""}
    assert steered.manager._named["extra"].controller.context.period_ns == 40_000_000


class Unbuilt(Scripted):
    def __init__(self, parameters):
        raise KeyError("no such calibration")


@pytest.mark.parametrize(
    ("options", "why"),
    [
        *(({"rate": rate}, "rate") for rate in (0.0, -1.0, 1e-320)),
        ({"type": "unbuilt"}, "no such calibration"),
        (b'{"unknown": ' + b"[" * 100_000 + b"]" * 100_000 + b"}", ""),
    ],
    ids=["rate 0", "negative rate", "tiny rate", "class that raises", "deeper than Python goes"],
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


def test_a_failure_does_not_count_for_a_later_controller_of_the_same_name():
    robot = Left(fallback="x")
    load = [robot.asks("pause"), robot.loads("x", active=False, **LEFT)]
    robot.run(4, {0: load, 1: robot.asks("resume"), 2: robot.breaks("left")})
    assert robot.refusals == {1: "", 2: "", 3: ""}
    assert robot.active(3) == ["x"]
