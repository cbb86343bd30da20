"""A loop that is steered: what is done in which cycle, what is refused and why, and what never happens."""

import gc
import sys

import msgspec
import numpy as np
import pytest

from dxlrun.channels.answers import Code, Done
from dxlrun.channels.events import EventCode
from dxlrun.plan.loop_plan import ControllerPlan
from dxlrun.plan.policy_plan import SLOW_SPEED

PERIOD_NS = 20_000_000


class Watched:
    """A robot with two arms' controllers and one for the whole body; every update is written down."""

    def __init__(self, make_robot, **options):
        self.robot = make_robot(joints=2)
        self.seen = []
        self.add("left", joints=("j0",), **options.get("left", {}))
        self.add("right", joints=("j1",), **options.get("right", {}))
        self.add("whole", joints=("j0", "j1"), active=False)
        self.at = {}

    def add(self, name, **options):
        def act(controller, step, time_ns, value):
            self.seen.append((self.robot.loop.record.cycle, name, step, time_ns, value))
            if step == "update":
                controller.context.commands.position[:] = 0.1
                controller.context.commands.velocity[:] = 1.0

        self.robot.script(name, act, **options)

    def run(self, cycles, **plan):
        """Run so many cycles; `at` maps a cycle to what is asked just before it."""
        robot = self.robot
        robot.build(**plan)
        robot.hardware.keep = False

        def idle(deadline_ns):
            number = len(robot.sink.cycles)
            for act in self.at.get(number, ()):
                act()
            if number == cycles - 1:
                robot.stop.request()

        robot.hardware.idle = idle
        return robot.loop.run()

    def steps(self, name, step):
        return [cycle for cycle, who, what, _, _ in self.seen if (who, what) == (name, step)]

    def active(self):
        return [cycle["active"] for cycle in self.robot.sink.cycles]


@pytest.fixture
def watched(make_robot):
    return Watched(make_robot)


def test_a_switch_happens_in_one_cycle_or_not_at_all(watched):
    robot = watched.robot
    watched.at[3] = [lambda: robot.ask("switch", activate=["whole"], deactivate=["left", "right"])]
    watched.run(6)
    assert watched.active() == [0b011] * 3 + [0b100] * 3
    assert watched.steps("left", "update") == [0, 1, 2]
    assert watched.steps("whole", "update") == [3, 4, 5]
    assert watched.steps("left", "deactivate") == watched.steps("whole", "activate") == [3]
    assert robot.answer(1) == Done(3)
    assert robot.events.of(EventCode.STEERED)[0][1].endswith("from anna")


def test_the_event_of_a_long_command_shows_only_its_begin(watched):
    robot = watched.robot
    watched.at[2] = [lambda: robot.ask("pause"), lambda: robot.ask("load", **loaded(name="extra" * 30))]
    watched.run(5)
    paused, text = [text for _, text in robot.events.of(EventCode.STEERED)]
    assert paused == "pause from anna"
    assert text.startswith('load {"name":')
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
    ],
)
def test_a_switch_that_cannot_be_is_refused_whole(watched, switch, code, why):
    robot = watched.robot
    watched.at[2] = [lambda: robot.ask("switch", **switch)]
    watched.run(5)
    assert why in robot.refusals[1]
    assert robot.answer(1)[0] is code
    assert watched.active() == [0b011] * 5
    assert why in robot.events.of(EventCode.COMMAND_REFUSED)[0][1]


def test_bytes_that_are_no_text_are_refused(watched):
    robot = watched.robot
    watched.at[2] = [lambda: robot.post("", "switch", b'{"activate": ["\xff"]}')]
    watched.run(5)
    assert robot.answer(1)[0] is Code.INVALID
    assert watched.active() == [0b011] * 5


def test_a_controller_in_both_lists_begins_anew(watched):
    watched.at[2] = [lambda: watched.robot.ask("switch", activate=["left"], deactivate=["left"])]
    watched.run(4)
    assert watched.steps("left", "activate") == [-1, 2]
    assert watched.steps("left", "update") == [0, 1, 2, 3]


def test_in_a_pause_time_stands_still_and_servos_are_held(watched):
    robot = watched.robot
    watched.at[3] = [lambda: robot.ask("pause")]
    watched.at[7] = [lambda: robot.ask("resume")]
    watched.run(10)
    times = [time_ns for _, name, step, time_ns, _ in watched.seen if (name, step) == ("left", "update")]
    periods = [value for _, name, step, _, value in watched.seen if (name, step) == ("left", "update")]
    assert watched.steps("left", "update") == [0, 1, 2, 7, 8, 9]
    assert times == [turn * PERIOD_NS for turn in range(6)]
    assert set(periods) == {PERIOD_NS}
    assert [cycle["cycle"] for cycle in robot.sink.cycles] == list(range(10))
    assert all(np.isnan(cycle["position"]).all() for cycle in robot.sink.cycles[3:7])


def test_after_a_pause_goals_that_moved_away_are_approached_slowly(make_robot):
    robot = make_robot(joints=1)
    wanted, goals = [0.1], []

    def follow(controller, step, *_):
        if step == "update":
            controller.context.commands.position[:] = wanted[-1]

    def idle(_):
        cycle = len(goals)
        if cycle in {60, 70}:  # the slow second after the start is over
            robot.ask("pause" if cycle == 60 else "resume")
        elif cycle == 65:
            wanted.append(-0.9)
        elif cycle == 75:
            robot.stop.request()

    robot.script("arm", follow)
    robot.build()
    robot.hardware.idle = idle
    robot.hardware.write = lambda: goals.append(robot.record.goals.position[0])
    robot.loop.run()
    assert goals[59] == goals[69] == 0.1
    assert goals[70:73] == pytest.approx([0.1 - SLOW_SPEED * 0.02 * step for step in (1, 2, 3)])


@pytest.mark.parametrize("kind", ["pause", "resume"])
def test_what_is_so_already_is_refused(watched, kind):
    robot = watched.robot
    watched.at[1] = [lambda: robot.ask("pause")] if kind == "pause" else []
    watched.at[2] = [lambda: robot.ask(kind)]
    watched.run(4)
    assert max(robot.refusals.items())[1].startswith("the loop is ")


def test_another_rate_begins_at_the_next_deadline_and_controllers_keep_theirs(make_robot):
    watched = Watched(make_robot, right={"every": 2, "rate": 25.0})
    robot = watched.robot
    watched.at[4] = [lambda: robot.ask("rate", rate=100.0)]
    watched.run(13)
    due = np.diff([cycle["scheduled_ns"] for cycle in robot.sink.cycles])
    assert due.tolist() == [PERIOD_NS] * 4 + [PERIOD_NS // 2] * 8
    assert np.diff(watched.steps("right", "update")).max() == 4
    periods = [value for cycle, name, step, _, value in watched.seen if (name, step) == ("right", "update")]
    assert periods[-1] == 2 * PERIOD_NS
    assert robot.patience == [PERIOD_NS // 2]


@pytest.mark.parametrize(
    ("rate", "code", "why"),
    [
        (60.0, Code.RATE_NOT_DIVIDED, "60 Hz is no multiple of 25 Hz, the rate of controller right"),
        (500.0, Code.RATE_OVER_BUSES, "at most 200 Hz"),
        (0.001, Code.RATE_OUT_OF_RANGE, "no rate of a loop; write 1 to 100000"),
        (0.0, Code.RATE_OUT_OF_RANGE, "no rate"),
        (-3.0, Code.RATE_OUT_OF_RANGE, "no rate"),
    ],
)
def test_a_rate_that_cannot_be_is_refused(make_robot, rate, code, why):
    watched = Watched(make_robot, right={"every": 2, "rate": 25.0})
    watched.at[1] = [lambda: watched.robot.ask("rate", rate=rate)]
    watched.run(4, least_period_ns=5_000_000)
    assert why in watched.robot.refusals[1]
    assert watched.robot.answer(1)[0] is code
    due = np.diff([cycle["scheduled_ns"] for cycle in watched.robot.sink.cycles])
    assert set(due.tolist()) == {PERIOD_NS}


def test_a_command_reaches_its_controller_and_the_log(watched):
    robot, data = watched.robot, np.array([0.5]).tobytes()
    watched.at[2] = [lambda: robot.post("left", "position", data)]
    watched.run(4)
    assert watched.steps("left", "command") == [2]
    assert [(one.cycle, one.planned, one.controller, one.data) for one in robot.taken] == [
        (2, -1, "left", data)
    ]
    assert [cycle["command_count"] for cycle in robot.sink.cycles] == [0, 0, 1, 0]


@pytest.mark.parametrize(
    ("name", "data", "why"),
    [
        ("whole", b"", (Code.NOT_ACTIVE, {"controller": "whole"})),
        ("nun", b"", (Code.UNKNOWN_CONTROLLER, {"controller": "nun"})),
        ("left", b"abc", (Code.INVALID, {"problem": "3 bytes are no array of numbers"})),
    ],
)
def test_a_command_that_cannot_be_is_refused(watched, name, data, why):
    watched.at[1] = [lambda: watched.robot.post(name, "position", data)]
    watched.run(3)
    assert watched.robot.answer(1) == why
    assert not watched.steps(name, "command")


def test_a_stream_that_ends_without_a_word_is_held_until_the_next_command(watched):
    robot = watched.robot
    for cycle in (1, 2, 3):
        watched.at[cycle] = [lambda: robot.post("left", "position", b"", 2 * PERIOD_NS)]
    watched.at[9] = [lambda: robot.post("left", "position", b"")]
    watched.run(15)
    assert watched.steps("left", "update") == [0, 1, 2, 3, 4, 5, 9, 10, 11, 12, 13, 14]
    assert robot.events.of(EventCode.STALE_COMMAND) == [
        ("left", "the stream of commands ended; its joints are held")
    ]
    assert np.isnan(robot.sink.cycles[7]["position"]).tolist() == [True, False]
    assert robot.sink.cycles[7]["active"] & 1


def loaded(name="extra", joints=("j0",)):
    plan = ControllerPlan(name, "left", "tests 1", "{}", joints, ("position", "velocity"), (), True, 1)
    return msgspec.to_builtins(plan)


def test_a_controller_is_loaded_and_unloaded_in_a_pause_only(watched):
    robot = watched.robot
    ask = robot.ask
    watched.at[1] = [lambda: ask("load", **loaded())]
    watched.at[2] = [lambda: ask("pause"), lambda: ask("load", **loaded())]
    watched.at[3] = [lambda: ask("resume"), lambda: ask("switch", activate=["extra"], deactivate=["left"])]
    watched.at[4] = [lambda: ask("unload", controller="extra")]
    watched.at[5] = [lambda: ask("pause"), lambda: ask("unload", controller="extra")]
    watched.at[6] = [lambda: ask("switch", activate=["left"], deactivate=["extra"])]
    watched.at[7] = [lambda: ask("unload", controller="extra"), lambda: ask("resume")]
    watched.run(10)
    refusals = {number: text for number, text in robot.refusals.items() if text}
    assert refusals == {
        1: "pause the loop first: it stands still meanwhile",
        6: "pause the loop first: it stands still meanwhile",
        8: "extra is active; deactivate it first",
    }
    assert [cycle["active"] for cycle in robot.sink.cycles][3:6] == [0b1010] * 3
    assert len(robot.events.of(EventCode.CONTROLLER_LOADED)) == 2


def test_a_controller_that_is_loaded_while_its_servo_is_lost_waits_for_it(watched):
    watched.robot.build()
    manager = watched.robot.manager
    manager.wait_for({0})
    for name, joint in (("extra", "j0"), ("other", "j1")):
        plan = ControllerPlan(name, "left", "tests 1", "{}", (joint,), ("position",), (), False, 1)
        assert isinstance(manager.load(plan), int)
    assert [manager._named[name].waiting for name in ("extra", "other")] == [True, False]


def test_a_controller_that_is_loaded_anew_after_its_failure_may_stand_in_again(make_robot):
    robot, failing = make_robot(joints=1), {"extra"}

    def act(controller, step, *_):
        if step == "update" and controller.context.name in failing:
            raise ValueError("no way")

    robot.script("left", act, fallback="extra")
    robot.build()
    manager = robot.manager
    command = ("position", "velocity")
    extra = ControllerPlan("extra", "left", "tests 1", "{}", ("j0",), command, (), False, 1, fallback="left")
    assert manager.load(extra) == 1
    assert manager.switch(("extra",), (), 0) is None
    for failed, stands_in in (("extra", "left"), ("left", "extra")):
        failing.clear()
        failing.add(failed)
        manager.begin()
        manager.update(0, 0)
        assert manager.active == (stands_in,)
        if stands_in == "left":
            assert manager.unload("extra") is None
            assert manager.load(extra) == 1
    assert manager.fault is None


def test_places_of_unloaded_controllers_are_used_again(watched):
    robot = watched.robot
    watched.at[1] = [lambda: robot.ask("pause")]
    for cycle in range(2, 200, 2):
        watched.at[cycle] = [lambda: robot.ask("load", **loaded())]
        watched.at[cycle + 1] = [lambda: robot.ask("unload", controller="extra")]
    watched.run(210)
    assert set(robot.refusals.values()) == {""}


def test_a_controller_is_loaded_into_the_first_free_place_under_whatever_name(watched):
    robot = watched.robot

    def ask(kind, name):
        wish = {"controller": name} if kind == "unload" else loaded() | {"name": name}
        return lambda: robot.ask(kind, **wish)

    steps = ("load", "a"), ("load", "b"), ("unload", "a"), ("unload", "b"), ("load", "b"), ("load", "c")
    watched.at[1] = [lambda: robot.ask("pause"), *(ask(*step) for step in steps)]
    watched.at[2] = [lambda: robot.ask("switch", activate=["c"], deactivate=["left"])]
    watched.run(4)
    assert set(robot.refusals.values()) == {""}
    assert watched.active()[2:] == [0b010010] * 2


def test_a_controller_is_loaded_with_the_period_that_the_loop_has_now(watched):
    robot = watched.robot
    watched.at[1] = [lambda: robot.ask("rate", rate=100.0), lambda: robot.ask("pause")]
    watched.at[2] = [
        lambda: robot.ask("load", **loaded() | {"rate": 30.0}),
        lambda: robot.ask("load", **loaded() | {"rate": 25.0}),
    ]
    watched.run(4)
    assert robot.refusals == {
        1: "",
        2: "",
        3: "100 Hz is no multiple of 30 Hz, the rate of controller extra",
        4: "",
    }
    assert robot.manager._named["extra"]._controller.context.period_ns == 40_000_000


def test_a_fallback_takes_over_in_the_cycle_of_the_fault(make_robot):
    watched = Watched(make_robot, left={"fallback": "careful"})
    robot = watched.robot
    watched.add("careful", joints=("j0",), active=False)

    def fail(controller, step, time_ns, value):
        if step == "update" and time_ns >= 3 * PERIOD_NS:
            raise RuntimeError("lost its way")

    robot._offers["left"].controller.act = fail
    result = watched.run(6)
    assert result.reason == "stopped"
    assert watched.active() == [0b0011] * 3 + [0b1010] * 3
    assert watched.steps("careful", "update") == [3, 4, 5]


def test_a_run_ends_when_it_is_asked_to(watched):
    watched.at[4] = [lambda: watched.robot.ask("stop")]
    result = watched.run(100)
    assert (result.reason, result.cycles) == ("stopped", 5)


def test_a_flood_is_taken_in_small_portions(watched):
    robot = watched.robot
    watched.at[1] = [lambda: [robot.post("left", "position") for _ in range(100)]]
    watched.run(20)
    counts = [cycle["command_count"] for cycle in robot.sink.cycles]
    assert max(counts) == 8
    assert sum(counts) == 100


def test_memory_stays_flat_and_nothing_is_collected_while_the_loop_is_steered(watched):
    """20,000 cycles with a set-point in each, a switch in every tenth, a pause now and then."""
    robot = watched.robot
    robot.build(end_ns=18_000 * PERIOD_NS)
    robot.hardware.keep = robot.sink.keep = False
    robot.events.emit = lambda *_: None
    robot.take = lambda _: None
    watched.seen = type("Nothing", (), {"append": lambda self, _: None})()
    robot.loop.commands = robot.loop.steering.taken = type("Nothing", (), {"take": lambda self, _: None})()
    robot.inbox.answer = lambda number, refusal: None
    marks = []

    def idle(deadline_ns):
        cycle = robot.loop.record.cycle + 1
        robot.post("left", "position", b"", PERIOD_NS)
        if cycle % 10 == 0:
            robot.ask("switch", activate=["right"], deactivate=["right"])
        if cycle % 1000 in (500, 510):
            robot.ask("pause" if cycle % 1000 == 500 else "resume")
        if cycle in (2_000, 17_000):
            marks.append((sys.getallocatedblocks(), sum(one["collections"] for one in gc.get_stats())))

    robot.hardware.idle = idle
    gc.collect()
    robot.loop.run()
    (early, collected), (late, collected_late) = marks
    assert collected_late == collected
    assert abs(late - early) < 60
