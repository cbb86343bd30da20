"""Goals: numbers, results, preemption, cancel, and what ends a goal that its controller does not end."""

import gc
import sys
from dataclasses import replace
from typing import Annotated, ClassVar

import msgspec
import numpy as np
import pytest
from pydantic import Field

from dxlrun.channels.answers import Code, Done
from dxlrun.channels.commands import data_of
from dxlrun.channels.cycle import CycleLayout, CycleRecord, Torque
from dxlrun.channels.events import EventCode, GoalReport
from dxlrun.contract.controller import (
    LIVE,
    CommandModel,
    Controller,
    Interfaces,
    Outcome,
    ParametersModel,
)
from dxlrun.control.controllers.goals import KEPT, Goals, GoalStatus
from dxlrun.control.controllers.plugins import controller_breach
from dxlrun.control.controllers.topics import TopicLog
from dxlrun.messages.declared import declared_message

PERIOD_NS = 20_000_000


class Move(CommandModel):
    seconds: float


class Gains(ParametersModel):
    p: Annotated[float, LIVE, Field(ge=0, le=10)] = 1.0
    d: float = 0.0


class Speeds(ParametersModel):
    speed: Annotated[float, LIVE] = 1.0
    careful: Annotated[bool, LIVE] = False
    size: int = 3
    gains: Gains = Gains()


class Mover(Controller[Speeds]):
    """Reaches a goal after as many updates as it says; comes to rest two updates after a cancel."""

    Parameters = Speeds
    Commands: ClassVar = {"move": Move, "nudge": Move}
    Goals: ClassVar = frozenset({"move"})
    steps: ClassVar[list] = []
    fail_in: ClassVar[set[str]] = set()

    @classmethod
    def interfaces(cls, parameters, joints):
        return Interfaces(joints, ("position", "velocity"))

    def _step(self, name, *values):
        self.steps.append((name, *values))
        if name in self.fail_in:
            raise RuntimeError("no way")

    def on_activate(self, time_ns):
        self.goal, self.left, self.resting = None, 0, 0

    def on_goal(self, goal, data, time_ns):
        self._step("goal", goal.number, goal.kind, data.tolist())
        self.goal, self.left, self.resting = goal, int(data[0]), 0

    def on_command(self, kind, data, time_ns):
        self._step("command", kind)

    def on_cancel(self, goal, time_ns):
        self._step("cancel", goal.number)
        self.resting = 2

    def on_parameters(self, time_ns):
        self._step("parameters", self.parameters)

    def update(self, time_ns, period_ns):
        self._step("update")
        if self.goal is None:
            return
        self.left -= 1
        self.goal.feedback(1 - self.left / 100, 0.5)
        if self.resting:
            self.resting -= 1
            if not self.resting:
                self.goal.end(Outcome.CANCELLED)
                self.goal = None
        elif self.left == 0:
            self.goal.end(Outcome.REACHED, joint="j0", error=0.001)
            self.goal = None


class Steered:
    """A robot with an arm that takes goals; `at` maps a cycle to what is requested just before it."""

    def __init__(self, make_robot, **options):
        self.robot = make_robot(joints=2)
        self.mover = type("OneMover", (Mover,), {"steps": [], "fail_in": set()})
        self.robot.add("arm", self.mover, joints=("j0",), **options)
        self.at = {}
        self.reports = []
        self.emit = self.robot.events.emit
        self.robot.events.emit = self._emit

    def _emit(self, code, severity, source, text, data=b""):
        self.emit(code, severity, source, text, data)
        if code in (EventCode.GOAL_ACCEPTED, EventCode.GOAL_ENDED):
            self.reports.append((self.robot.loop.record.cycle, msgspec.json.decode(data, type=GoalReport)))

    def run(self, cycles):
        robot = self.robot
        robot.build()
        robot.hardware.keep = False

        def idle(deadline_ns):
            number = len(robot.sink.cycles)
            for act in self.at.get(number, ()):
                act()
            if number == cycles - 1:
                robot.stop.request()

        robot.hardware.idle = idle
        return robot.loop.run()

    def move(self, updates):
        return lambda: self.robot.post("arm", "move", np.array([updates], dtype="<f8").tobytes())

    def ask(self, kind, **data):
        return lambda: self.robot.ask(kind, **data)

    @property
    def statuses(self):
        return [(report.goal, report.status) for _, report in self.reports]

    def steps(self, name):
        return [step[1:] for step in self.mover.steps if step[0] == name]


@pytest.fixture
def steered(make_robot):
    return Steered(make_robot)


def test_a_goal_has_a_number_and_a_result(steered):
    steered.at = {2: [steered.move(3)], 7: [steered.move(1)]}
    steered.run(10)
    assert steered.statuses == [(1, "accepted"), (1, "reached"), (2, "accepted"), (2, "reached")]
    assert [cycle for cycle, _ in steered.reports] == [2, 4, 7, 7]
    assert steered.reports[1][1] == GoalReport(
        1, "arm", "move", "anna", "reached", "j0 is 0.001 off", "j0", 0.001
    )
    assert steered.robot.answer(1) == Done(2, goals=(1,))
    assert steered.steps("goal") == [(1, "move", [3.0]), (2, "move", [1.0])]
    assert not steered.robot.events.of(EventCode.COMMAND)


def test_a_command_that_is_no_goal_goes_on_command_and_has_no_number(steered):
    steered.at = {2: [lambda: steered.robot.post("arm", "nudge")]}
    steered.run(4)
    assert steered.robot.answer(1) == Done(2)
    assert (steered.steps("command"), steered.statuses) == ([("nudge",)], [])


def test_planned_commands_are_goals(steered):
    steered.robot.send(2 * PERIOD_NS, "arm", "move", 2.0)
    steered.run(6)
    assert [(cycle, one.status, one.origin) for cycle, one in steered.reports] == [
        (2, "accepted", "motion.yaml:7:5"),
        (3, "reached", "motion.yaml:7:5"),
    ]


def test_each_goal_takes_the_place_of_the_one_before(steered):
    steered.at = {cycle: [steered.move(50)] for cycle in (1, 2, 3)}
    steered.at[3] *= 2
    steered.run(5)
    assert steered.statuses == [
        (1, "accepted"),
        (1, "preempted"),
        (2, "accepted"),
        (2, "preempted"),
        (3, "accepted"),
        (3, "preempted"),
        (4, "accepted"),
        (4, "aborted"),
    ]
    assert steered.reports[1][1].text == "goal 2 took its place"


def test_a_cancelled_goal_ends_when_its_controller_is_at_rest(steered):
    steered.at = {1: [steered.move(50)], 3: [steered.ask("cancel", goal=1)]}
    steered.run(8)
    assert steered.statuses == [(1, "accepted"), (1, "cancelled")]
    assert steered.reports[-1][0] == 4
    assert steered.robot.answer(2) == Done(3)


def test_a_goal_is_cancelled_by_the_name_of_its_controller(steered):
    steered.at = {1: [steered.move(50)], 3: [steered.ask("cancel", controller="arm")]}
    steered.run(8)
    assert steered.statuses[-1] == (1, "cancelled")


def refused(steered, number):
    code, _ = steered.robot.answer(number)
    return code, steered.robot.refusals[number]


def test_a_cancel_that_comes_twice_is_refused_with_one_sentence(steered):
    cancel = steered.ask("cancel", goal=1)
    steered.at = {1: [steered.move(50)], 3: [cancel, cancel], 6: [cancel]}
    steered.run(8)
    assert refused(steered, 3) == (Code.CANCELLED_ALREADY, "goal 1 is being cancelled already")
    assert refused(steered, 4) == (Code.GOAL_ENDED, "goal 1 has ended already: cancelled")
    assert steered.steps("cancel") == [(1,)]


def test_a_goal_that_ends_in_the_cycle_of_its_cancel_has_one_result(steered):
    steered.at = {
        1: [steered.move(3)],
        3: [steered.ask("cancel", goal=1)],
        4: [steered.ask("cancel", goal=1)],
    }

    def on_cancel(self, goal, time_ns):
        """Go on to the goal, which is reached in this cycle."""

    steered.mover.on_cancel = on_cancel
    steered.run(8)
    assert steered.statuses == [(1, "accepted"), (1, "reached")]
    assert steered.reports[-1][0] == 3
    assert refused(steered, 3) == (Code.GOAL_ENDED, "goal 1 has ended already: reached")


@pytest.mark.parametrize(
    ("request_", "code", "text"),
    [
        ({"goal": 7}, Code.UNKNOWN_GOAL, "there is no goal 7; the newest is 1"),
        ({"goal": -1}, Code.UNKNOWN_GOAL, "there is no goal -1; the newest is 1"),
        ({"controller": "leg"}, Code.UNKNOWN_CONTROLLER, "there is no controller leg"),
        ({"controller": "arm"}, Code.NO_GOAL, "arm has no goal"),
        ({"goal": 0}, Code.UNKNOWN_GOAL, "there is no goal 0; the newest is 1"),
    ],
)
def test_a_cancel_of_what_there_is_not_is_refused(steered, request_, code, text):
    steered.at = {1: [steered.move(1)], 3: [steered.ask("cancel", **request_)]}
    steered.run(5)
    assert refused(steered, 2) == (code, text)


def test_deactivation_aborts_the_goal_and_a_result_that_comes_later_counts_no_more(steered):
    def on_deactivate(self, time_ns):
        self.goal.end(Outcome.REACHED)

    steered.mover.on_deactivate = on_deactivate
    steered.at = {1: [steered.move(50)], 3: [steered.ask("switch", deactivate=["arm"])]}
    steered.run(5)
    assert [(cycle, one.status, one.text) for cycle, one in steered.reports[1:]] == [
        (3, "aborted", "arm was deactivated")
    ]


@pytest.mark.parametrize("step", ["goal", "cancel", "update"])
def test_a_fault_aborts_the_goal_and_the_fallback_takes_over(make_robot, step):
    steered = Steered(make_robot, fallback="careful")
    steered.robot.script("careful", lambda *_: None, joints=("j0",), active=False)
    steered.at = {1: [steered.move(50)], 3: [steered.ask("cancel", goal=1)]}
    steered.mover.fail_in = {step} if step != "update" else set()
    if step == "update":
        steered.at[2] = [lambda: steered.mover.fail_in.add("update")]
    steered.run(6)
    assert steered.statuses == [(1, "accepted"), (1, "aborted")]
    where = {"goal": "on_goal (move)", "cancel": "on_cancel", "update": "update"}[step]
    assert f"raised in {where}: RuntimeError: no way" in steered.reports[-1][1].text
    assert steered.robot.manager.active == ()
    assert [cycle["active"] for cycle in steered.robot.sink.cycles][-1] == 0b10


@pytest.mark.parametrize("outcome", ["arrived", None, 3])
def test_an_outcome_that_is_none_is_the_controllers_fault(steered, outcome):
    def update(self, time_ns, period_ns):
        if self.goal:
            self.goal.end(outcome)

    steered.mover.update = update
    steered.at = {1: [steered.move(5)]}
    assert steered.run(5).reason == "fault"
    assert steered.statuses == [(1, "accepted"), (1, "aborted")]


def torque_of(steered, torque, valid=True, row=0):
    """Give a joint another torque, and its reply or none, from a cycle on."""

    def change():
        states = steered.robot.record.states
        states.torque[row], states.valid[row] = torque, valid

    return change


@pytest.mark.parametrize(
    ("torque", "valid"), [(Torque.DOUBT, True), (Torque.ON, False)], ids=["torque", "reply"]
)
def test_reached_waits_for_torque_and_replies_but_not_for_ever(steered, torque, valid):
    steered.at = {
        2: [steered.move(3)],
        3: [torque_of(steered, torque, valid)],
        9: [torque_of(steered, Torque.ON)],
        10: [steered.move(1), torque_of(steered, torque, valid)],
    }
    steered.run(60)
    found = [(cycle, one.status) for cycle, one in steered.reports]
    assert found == [(2, "accepted"), (9, "reached"), (10, "accepted"), (35, "aborted")]
    why = "has not confirmed its torque" if valid else "has not answered"
    assert (steered.reports[-1][1].joint, steered.reports[-1][1].text) == ("j0", f"joint j0 {why}")


def test_a_goal_that_waits_can_be_replaced_and_ends_once(steered):
    steered.at = {
        2: [steered.move(1), torque_of(steered, Torque.DOUBT)],
        4: [steered.move(1), torque_of(steered, Torque.ON)],
    }
    steered.run(8)
    assert steered.statuses == [(1, "accepted"), (1, "preempted"), (2, "accepted"), (2, "reached")]


@pytest.mark.parametrize("torque", [Torque.OFF, Torque.RELEASED, Torque.LOST, Torque.REBOOTING])
def test_a_goal_of_a_joint_that_goes_nowhere_is_aborted(steered, torque):
    steered.at = {2: [steered.move(1), torque_of(steered, torque)]}
    steered.run(5)
    assert steered.statuses == [(1, "accepted"), (1, "aborted")]
    assert steered.reports[-1][1].joint == "j0"


def test_a_joint_of_another_controller_does_not_count(steered):
    steered.at = {2: [steered.move(1), torque_of(steered, Torque.OFF, row=1)]}
    steered.run(5)
    assert steered.statuses == [(1, "accepted"), (1, "reached")]


def test_a_goal_is_not_streamed(steered):
    data = np.array([5.0]).tobytes()
    steered.at = {1: [lambda: steered.robot.post("arm", "move", data, PERIOD_NS)]}
    steered.run(3)
    assert refused(steered, 1) == (Code.GOAL_STREAMED, "move of arm is a goal; send it once, not in a stream")


@pytest.fixture
def messages(steered, monkeypatch):
    """What is published on /goals, with the cycle."""
    seen = []

    class Published:
        def publish(self, message):
            seen.append((steered.robot.loop.record.cycle, replace(message)))

    monkeypatch.setattr(TopicLog, "open", lambda self, name, cls: Published())
    return seen


def test_the_topic_has_feedback_ten_times_a_second_between_acceptance_and_result(steered, messages):
    steered.at = {1: [steered.move(50)]}
    steered.run(52)
    assert [cycle for cycle, one in messages if one.status == "running"] == list(range(1, 51, 5))
    assert [one.status for _, one in messages if one.status != "running"] == ["accepted", "reached"]
    third, last = messages[3][1], messages[-1][1]
    assert (third.goal, third.controller, third.progress, third.error) == (1, "arm", 1 - 39 / 100, 0.5)
    assert (last.progress, last.joint, last.error, last.text) == (1.0, "j0", 0.001, "j0 is 0.001 off")


def test_the_topic_of_goals_is_a_message_of_ros():
    found = declared_message(GoalStatus, "dxlrun_msgs")
    assert found.type.name == "dxlrun_msgs/msg/GoalStatus"
    assert found.stamped
    assert found.pack(GoalStatus(goal=3, text="Ü"), (1, 2))


def test_a_text_that_no_utf8_has_is_reported_with_escapes(steered):
    def update(self, time_ns, period_ns):
        if self.goal:
            self.goal.end(Outcome.ABORTED, "no \udcff" + 1000 * "a", "\udcfe")

    steered.mover.update = update
    steered.at = {1: [steered.move(5)]}
    assert steered.run(4).reason == "stopped"
    text = steered.reports[-1][1].text
    assert (text.startswith("no \\udcff"), len(text) < 600) == (True, True)


def test_only_the_last_results_are_kept_and_memory_stays_flat(steered):
    goals, robot = 7 * KEPT + 20, steered.robot  # numbers up to 256 are Python's own objects
    marks = []
    for cycle in range(1, goals + 1):
        steered.at[cycle] = [steered.move(1)]
    steered.emit = lambda *_: None

    def mark():
        steered.reports.clear()
        robot.inbox.answers.clear()
        steered.mover.steps.clear()
        robot.sink.cycles[:] = [None] * len(robot.sink.cycles)
        robot.taken.clear()
        gc.collect()
        marks.append(sys.getallocatedblocks())

    steered.at[2 * KEPT].append(mark)
    steered.at[7 * KEPT].append(mark)
    steered.at[goals + 2] = [steered.ask("cancel", goal=1), steered.ask("cancel", goal=goals)]
    steered.run(goals + 4)
    assert refused(steered, goals + 1)[1] == "goal 1 has ended already: long ago"
    assert refused(steered, goals + 2)[1] == f"goal {goals} has ended already: reached"
    assert not robot.manager._goals.running
    assert abs(marks[1] - marks[0]) < 2 * KEPT, "less than half an object a goal"


def test_live_parameters_change_together_at_one_cycle(steered):
    values = {"speed": 0.5, "careful": True, "gains.p": 4.0}
    steered.at = {3: [steered.ask("parameters", controller="arm", values=values)]}
    steered.run(5)
    changed = Speeds(speed=0.5, careful=True, gains=Gains(p=4.0))
    assert steered.steps("parameters") == [(changed,)]
    assert steered.robot.answer(1) == Done(3)
    ((source, text),) = steered.robot.events.of(EventCode.PARAMETERS)
    assert (source, text) == ("arm", "speed = 0.5, careful = 1, gains.p = 4")
    assert steered.robot.taken[0].kind == "parameters"


def test_changed_parameters_survive_a_switch_in_the_same_cycle_and_later_ones(steered):
    steered.at = {
        2: [
            steered.ask("switch", deactivate=["arm"]),
            steered.ask("parameters", controller="arm", values={"speed": 0.25}),
        ],
        4: [steered.ask("switch", activate=["arm"])],
    }
    steered.run(6)
    assert set(steered.robot.refusals.values()) == {""}
    assert steered.robot.manager._named["arm"]._controller.parameters.speed == 0.25


@pytest.mark.parametrize(
    ("values", "code", "text"),
    [
        ({"size": 4}, Code.INVALID, "arm: size is no live parameter"),
        ({"speed": 2.0, "gains.q": 1.0}, Code.INVALID, "arm: gains.q is no live parameter"),
        ({"gains": 1.0}, Code.INVALID, "arm: gains is no live parameter"),
        ({"speed": "fast"}, Code.INVALID, "the data of parameters do not fit"),
    ],
)
def test_parameters_that_are_not_live_are_refused_whole(steered, values, code, text):
    steered.at = {2: [steered.ask("parameters", controller="arm", values=values)]}
    steered.run(4)
    found = refused(steered, 1)
    assert found[0] is code
    assert text in found[1]
    assert steered.steps("parameters") == []
    assert steered.robot.manager._named["arm"]._controller.parameters == Speeds()


@pytest.mark.parametrize("active", [True, False])
def test_a_controller_that_raises_in_on_parameters_breaks_its_contract(make_robot, active):
    steered = Steered(make_robot, fallback="careful", active=active)
    steered.robot.script("careful", lambda *_: None, joints=("j0",), active=False)
    steered.mover.fail_in = {"parameters"}
    steered.at = {2: [steered.ask("parameters", controller="arm", values={"speed": 2.0})]}
    result = steered.run(5)
    assert result.reason == "stopped"
    assert refused(steered, 1) == (
        Code.CONTROLLER_FAULT,
        "controller arm raised in on_parameters: RuntimeError: no way",
    )
    assert [cycle["active"] for cycle in steered.robot.sink.cycles][-1] == (0b10 if active else 0)


class TextLive(ParametersModel):
    word: Annotated[str, LIVE] = "a"


class Inner(ParametersModel):
    most: Annotated[float | None, LIVE] = None


class Outer(ParametersModel):
    inner: Inner = Inner()


@pytest.mark.parametrize(
    ("changed", "what"),
    [
        ({"Parameters": TextLive}, "whose parameter word is LIVE and is neither a number nor a bool"),
        ({"Parameters": Outer}, "whose parameter inner.most is LIVE"),
        ({"Goals": frozenset({"jump"})}, "whose goal jump is none of its Commands"),
        ({"Goals": ("move",)}, "whose Goals is no set of names"),
        ({"Goals": frozenset({3})}, "whose Goals is no set of names"),
        ({"on_goal": Controller.on_goal}, "which has Goals and no method on_goal"),
        ({"on_goal": lambda self, goal: None}, "whose on_goal(goal) cannot be called as"),
        ({"on_cancel": lambda self: None}, "whose on_cancel() cannot be called as"),
        ({"on_parameters": lambda self: None}, "whose on_parameters() cannot be called as"),
    ],
)
def test_a_wrong_declaration_is_refused_when_the_plug_in_is_loaded(changed, what):
    assert controller_breach(Mover) is None
    breach = controller_breach(type("Wrong", (Mover,), changed))
    assert breach is not None
    assert what in breach[0]


@pytest.mark.parametrize(("torque", "outcome"), [(Torque.ON, "missed"), (Torque.OFF, "aborted")])
def test_a_goal_that_a_limp_joint_misses_is_aborted_because_of_it(torque, outcome):
    seen = []
    record = CycleRecord(CycleLayout(("j0",), ("arm",)))
    record.states.torque[:], record.states.valid[:] = torque, True

    class Events:
        emit = staticmethod(lambda *event: seen.append(event))

    goal = Goals(record, Events, ("j0",), lambda controller: ("j0",)).accept("arm", "move", "anna")
    goal.end(Outcome.MISSED, "", "j0", 0.2)
    assert goal.outcome == outcome
    assert ("j0 has no torque" in seen[-1][3]) is (outcome == "aborted")


# Motions


def motion(*parts, numbers=None):
    """Return the data of `play`: each part is a controller, a command, its times (cycles) and its arrays."""
    heads = [
        {
            "controller": controller,
            "kind": kind,
            "at_ns": [round(cycle * PERIOD_NS) for cycle in times],
            "sizes": [len(array) for array in arrays],
            "end_ns": end * PERIOD_NS,
        }
        for controller, kind, times, arrays, end in parts
    ]
    values = [value for *_, arrays, _ in parts for array in arrays for value in array]
    return msgspec.json.encode({"parts": heads}) + b"\n" + np.array(numbers or values, dtype="<f8").tobytes()


@pytest.fixture
def played(make_robot):
    """A robot with an arm that takes goals, and a leg that writes down its plain commands."""
    steered = Steered(make_robot)
    steered.given = []

    def act(controller, step, time_ns, value):
        if step == "command":
            steered.given.append((steered.robot.loop.record.cycle, value.tolist()))
            if steered.given[-1][1] == [13.0]:
                raise RuntimeError("no way")

    steered.robot.script("leg", act, joints=("j1",))
    steered.play = lambda *parts, **more: lambda: steered.robot.post("", "play", motion(*parts, **more))
    return steered


LEG = ("leg", "go", (0, 1, 4), ([1.0], [2.0], [3.0]), 6)
ARM = ("arm", "move", (0,), ([4.0],), 0)


def test_the_parts_of_a_motion_begin_in_one_cycle_and_are_goals(played):
    played.at = {2: [played.play(LEG, ARM)]}
    played.run(12)
    assert played.robot.answer(1) == Done(2, goals=(1, 2))
    assert played.given == [(2, [1.0]), (3, [2.0]), (6, [3.0])]
    assert played.steps("goal") == [(2, "move", [4.0])]
    assert [(cycle, one.goal, one.status) for cycle, one in played.reports] == [
        (2, 1, "accepted"),
        (2, 2, "accepted"),
        (5, 2, "reached"),
        (8, 1, "reached"),
    ]
    assert played.robot.manager._motions == {}
    (taken,) = played.robot.taken
    assert (taken.kind, taken.numbers.tolist()) == ("play", [1.0, 2.0, 3.0, 4.0])
    assert data_of("", taken.text, taken.numbers) == taken.data
    assert len(played.robot.events.of(EventCode.STEERED)[0][1]) < 400


def test_a_played_motion_is_cancelled(played):
    played.at = {2: [played.play(LEG)], 4: [played.ask("cancel", controller="leg")]}
    played.run(9)
    assert played.given == [(2, [1.0]), (3, [2.0])]
    assert (played.reports[-1][0], played.reports[-1][1].status) == (4, "cancelled")


@pytest.mark.parametrize("other", ["command", "motion"])
def test_what_comes_later_takes_the_place_of_a_motion(played, other):
    data = np.array([7.0]).tobytes()
    later = {
        "command": lambda: played.robot.post("leg", "go", data),
        "motion": played.play(("leg", "go", (0,), ([7.0],), 1)),
    }[other]
    played.at = {2: [played.play(LEG)], 4: [later]}
    played.run(9)
    assert played.given == [(2, [1.0]), (3, [2.0]), (4, [7.0])]
    assert played.reports[1][1].status == "preempted"


def test_a_played_motion_of_a_limp_joint_is_aborted(played):
    played.at = {2: [played.play(LEG, ARM)], 4: [torque_of(played, Torque.OFF, row=1)]}
    played.run(12)
    ended = {one.controller: (one.status, one.text) for _, one in played.reports}
    limp = "joint j1 has no torque: it was reset, its torque was cut, or it shut itself down"
    assert ended["leg"] == ("aborted", f"{limp}; all commands were given")
    assert ended["arm"][0] == "reached"


def test_a_deactivated_controller_gets_nothing_more_of_a_motion(played):
    played.at = {
        2: [played.play(LEG)],
        3: [played.ask("switch", deactivate=["leg"])],
        4: [played.ask("switch", activate=["leg"])],
    }
    played.run(9)
    assert played.given == [(2, [1.0])]
    assert played.statuses == [(1, "accepted"), (1, "aborted")]


def test_a_motion_ends_when_one_above_takes_its_controller_over(played):
    """The controller's own `on_cancel` knows nothing of it: a motion is the runtime's goal."""
    robot = played.robot
    robot._controllers.clear()
    one = {"joints": ("j1",), "command": ("position",)}
    robot.add("lower", played.mover, reference=("position",), **one)
    robot.script("upper", lambda *_: None, into=("lower",), active=False, **one)
    part = ("lower", "nudge", (0, 1, 4), ([1.0], [2.0], [3.0]), 6)
    played.at = {2: [played.play(part)], 4: [played.ask("switch", activate=["upper"])]}
    played.run(9)
    assert (played.reports[-1][0], played.reports[-1][1].status) == (4, "cancelled")
    assert robot.manager._motions == {}
    assert not played.steps("cancel")


def test_a_goal_beside_a_stream_that_runs_out_is_aborted(steered):
    """Its controller is held from then on, so it could not end the goal itself."""

    def stream():
        steered.robot.post("arm", "nudge", np.array([0.0]).tobytes(), lease_ns=2 * PERIOD_NS)

    steered.at = {2: [steered.move(100)], 3: [stream], 9: [steered.ask("cancel", controller="arm")]}
    steered.run(12)
    assert steered.statuses == [(1, "accepted"), (1, "aborted")]
    assert steered.reports[-1][1].text == "the stream of commands ended"
    assert refused(steered, 3)[0] is Code.NO_GOAL


def test_a_controller_that_fails_in_a_motion_is_taken_out(played):
    played.at = {2: [played.play(("leg", "go", (0, 1, 2), ([1.0], [13.0], [3.0]), 3), ARM)]}
    assert played.run(9).reason == "fault"
    assert played.given == [(2, [1.0]), (3, [13.0])]
    assert (1, "aborted") in played.statuses


def test_a_goal_that_fails_cancels_the_others_of_the_motion(played):
    played.mover.fail_in = {"goal"}
    played.at = {2: [played.play(LEG, ARM)]}
    played.run(9)
    assert refused(played, 1)[0] is Code.CONTROLLER_FAULT
    assert played.statuses == [(1, "accepted"), (2, "accepted"), (2, "aborted"), (1, "cancelled")]


@pytest.mark.parametrize(
    ("parts", "numbers", "code"),
    [
        ([LEG, ("head", "go", (0,), ([1.0],), 0)], None, Code.UNKNOWN_CONTROLLER),
        ([LEG, ("arm", "move", (1,), ([1.0],), 0)], None, Code.INVALID),
        ([LEG, ("arm", "move", (0, 1), ([1.0], [1.0]), 0)], None, Code.INVALID),
        ([LEG, ("arm", "move", (), (), 0)], None, Code.INVALID),
        ([LEG], [1.0, 2.0], Code.INVALID),
        ([LEG], [1.0, 2.0, 3.0, 4.0], Code.INVALID),
    ],
)
def test_a_motion_that_does_not_fit_is_refused_whole(played, parts, numbers, code):
    played.at = {2: [played.play(*parts, numbers=numbers)]}
    played.run(6)
    assert refused(played, 1)[0] is code
    assert (played.given, played.statuses) == ([], [])


def test_a_motion_of_a_controller_that_is_not_active_is_refused_whole(played):
    played.at = {1: [played.ask("switch", deactivate=["arm"])], 2: [played.play(LEG, ARM)]}
    played.run(6)
    assert refused(played, 2) == (Code.NOT_ACTIVE, "arm is not active; switch to it first")
    assert played.given == []
