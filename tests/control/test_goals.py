"""Goals to the cycle: results, settling, feedback and memory; what clients request is in `tests/steering`."""

import gc
import sys
from dataclasses import replace
from typing import ClassVar

import msgspec
import numpy as np
import pytest
from tests.kit.loops import PERIOD_NS, Hardware, Robot

from dxlrun.channels.cycle import Torque
from dxlrun.channels.event_records import EventCode, GoalHistory, GoalReport
from dxlrun.contract.controller import CommandModel, Controller, Interfaces, Outcome, ParametersModel
from dxlrun.control.controllers.goal_registry import KEPT, GoalStatus
from dxlrun.control.controllers.published_topics import TopicLog
from dxlrun.messages.declared import declared_message


class Move(CommandModel):
    seconds: float


class Mover(Controller[ParametersModel]):
    """Reaches a goal after as many updates as it says."""

    Parameters = ParametersModel
    Commands: ClassVar = {"move": Move, "nudge": Move}
    Goals: ClassVar = frozenset({"move"})
    cancelled: ClassVar[list] = []

    @classmethod
    def interfaces(cls, parameters, joints):
        return Interfaces(joints, ("position", "velocity"))

    def on_activate(self, time_ns):
        self.goal, self.left = None, 0

    def on_goal(self, goal, data, time_ns):
        self.goal, self.left = goal, int(data[0])

    def on_cancel(self, goal, time_ns):
        self.cancelled.append(goal.number)

    def update(self, time_ns, period_ns):
        if self.goal is None:
            return
        self.left -= 1
        self.goal.feedback(1 - self.left / 100, 0.5)
        if self.left == 0:
            self.goal.end(Outcome.REACHED)
            self.goal = None


class Story(Robot):
    """A robot with an arm that takes goals, and a leg."""

    def __init__(self):
        super().__init__()
        self.mover = type("OneMover", (Mover,), {"cancelled": []})
        self.add("arm", self.mover, joints=("j0",)).script("leg", joints=("j1",))
        self.reports = []
        self.events.emit_event = self._emit

    def _emit(self, source, event, data=b""):
        if event.code in (EventCode.GOAL_ACCEPTED, EventCode.GOAL_ENDED):
            self.reports.append((self.record.cycle, msgspec.json.decode(data, type=GoalReport)))

    def moves(self, updates):
        """Return what sends the arm a goal that takes so many updates."""
        return self.posts("arm", "move", [updates])

    def cancels(self, goal=1):
        return self.asks("cancel", goal=goal)

    def torque(self, torque, valid=True):
        """Return what gives the arm another torque, and its reply or none, from a cycle on."""

        def change():
            self.record.states.torque[0], self.record.states.valid[0] = torque, valid

        return change

    @property
    def statuses(self):
        return [(report.goal, report.status) for _, report in self.reports]

    @property
    def timed(self):
        return [(cycle, report.status) for cycle, report in self.reports]


@pytest.fixture
def story():
    return Story()


def test_refused_goal_of_a_client_does_not_count(story):
    story.mover.on_goal = lambda self, goal, data, time_ns: goal.end(Outcome.ABORTED, "out of reach")
    story.run(3, {1: story.moves(3)})
    for origin, asked in (("a client", 0), ("motion.yaml:7:5", 1)):
        history = GoalHistory()
        history.planned = {"motion.yaml:7:5"}
        for _, report in story.reports:
            history.count_report(msgspec.structs.replace(report, origin=origin))
        assert (history.totals.asked, len(history.totals.failed)) == (asked, asked)


@pytest.mark.parametrize("outcome", ["arrived", None, 3])
def test_an_outcome_that_is_none_is_the_controllers_fault(story, outcome):
    story.mover.update = lambda self, *_: self.goal.end(outcome) if self.goal else None
    assert story.run(5, {1: story.moves(5)}).reason == "fault"
    assert story.statuses == [(1, "accepted"), (1, "aborted")]


@pytest.mark.parametrize(
    ("torque", "valid"), [(Torque.DOUBT, True), (Torque.ON, False)], ids=["torque", "reply"]
)
def test_reached_waits_for_torque_and_replies_but_not_for_ever(story, torque, valid):
    doubt, sure = story.torque(torque, valid), story.torque(Torque.ON)
    story.run(80, {2: story.moves(3), 3: doubt, 9: sure, 10: [story.moves(1), doubt]})
    assert story.timed == [(2, "accepted"), (9, "reached"), (10, "accepted"), (60, "aborted")]
    why = "has not confirmed its torque" if valid else "has not answered"
    assert (story.reports[-1][1].joint, story.reports[-1][1].text) == ("j0", f"after 1.000 s, joint j0 {why}")


def test_a_joint_that_was_lost_settles_from_its_return_on(story):
    lost, doubt, sure = map(story.torque, (Torque.LOST, Torque.DOUBT, Torque.ON))
    story.run(90, {2: [story.moves(1), lost], 40: doubt, 70: sure})
    assert story.timed == [(2, "accepted"), (70, "reached")]


def test_the_topic_has_feedback_ten_times_a_second_between_acceptance_and_result(story, monkeypatch):
    messages = []

    class Published:
        def publish(self, message):
            messages.append((story.record.cycle, replace(message)))

    monkeypatch.setattr(TopicLog, "open", lambda self, name, cls: Published())
    story.run(52, {1: story.moves(50)})
    assert [cycle for cycle, one in messages if one.status == "running"] == list(range(1, 51, 5))
    assert [one.status for _, one in messages if one.status != "running"] == ["accepted", "reached"]
    third, last = messages[3][1], messages[-1][1]
    assert (third.goal, third.controller, third.progress, third.error) == (1, "arm", 1 - 39 / 100, 0.5)
    assert (last.progress, last.joint, last.text) == (1.0, "", "after 0.980 s")
    declared = declared_message(GoalStatus, "dxlrun_msgs")
    assert (declared.type.name, declared.stamped) == ("dxlrun_msgs/msg/GoalStatus", True)
    assert declared.pack(GoalStatus(goal=3, text="Ü"), (1, 2))


def test_a_text_that_no_utf8_has_is_reported_with_escapes(story):
    def update(self, *_):
        if self.goal:
            self.goal.end(Outcome.ABORTED, "no \udcff" + 1000 * "a", "\udcfe")

    story.mover.update = update
    assert story.run(4, {1: story.moves(5)}).reason == "stopped"
    text = story.reports[-1][1].text
    assert (text.startswith("no \\udcff"), len(text) < 600) == (True, True)


def test_only_the_last_results_are_kept_and_memory_stays_flat(story):
    goals, marks = 7 * KEPT + 20, []  # numbers up to 256 are Python's own objects

    def mark():
        for kept in (story.reports, story.inbox.answers, story.taken, story.calls):
            kept.clear()
        story.sink.cycles[:] = [None] * len(story.sink.cycles)
        story.hardware.written.clear()
        gc.collect()
        marks.append(sys.getallocatedblocks())

    at = {cycle: [story.moves(1)] for cycle in range(1, goals + 1)}
    at[2 * KEPT].append(mark)
    at[7 * KEPT].append(mark)
    story.run(goals + 4, at | {goals + 2: [story.cancels(), story.cancels(goals)]})
    assert story.refusals[goals + 1] == "goal 1 has ended already: long ago"
    assert story.refusals[goals + 2] == f"goal {goals} has ended already: reached"
    assert not story.manager._goals.running
    assert abs(marks[1] - marks[0]) < 2 * KEPT, "less than half an object a goal"


# Motions


@pytest.mark.parametrize(
    ("asked", "velocity", "status", "why"),
    [
        (0.25, 0.0, "reached", "all commands were sent"),
        (0.30, 0.0, "reached", "all commands were sent"),
        (0.45, 0.0, "missed", "joint j1 is 11.46 deg off; all commands were sent"),
        (0.25, 4.38, "missed", "joint j1 still moves at 250.96 deg/s; all commands were sent"),
    ],
)
def test_the_last_positions_of_a_played_motion_are_its_goal(story, asked, velocity, status, why):
    """The joint stands at 0.25 rad."""

    def stand():
        story.record.states.velocity[1] = velocity

    part = {"controller": "leg", "kind": "go", "at_ns": [0], "sizes": [1], "end_ns": 0, "positions": [asked]}
    command = msgspec.json.encode({"parts": [part]}) + b"\n" + np.array([0.5]).tobytes()
    story.run(70, {1: stand, 2: story.posts("", "play", command)})
    (_, ended) = story.reports[-1]
    assert (ended.status, ended.text) == (status, why)
    cycle = story.timed[-1][0]
    assert cycle == (2 if status == "reached" else 52), "it waits for a second"


def judged_off(story, monkeypatch):
    """Let the arm hand over goals 0.15 rad away from its joint, which never moves: it has 1 s to settle."""

    def update(self, *_):
        if self.goal is not None:
            self.goal.judge(np.array([0.4]))
            self.goal = None

    story.mover.update = update
    monkeypatch.setattr(Hardware, "read_states", lambda self: None)


def test_reached_is_judged_by_what_the_controller_commands(story, monkeypatch):
    """The controller says that it is done; its joint is where it was."""

    def update(self, *_):
        if self.goal is not None:
            self.context.commands.position.fill(0.4)
            self.goal.end(Outcome.REACHED)
            self.goal = None

    story.mover.update = update
    monkeypatch.setattr(Hardware, "read_states", lambda self: None)
    story.run(70, {2: story.moves(1)})
    assert story.timed == [(2, "accepted"), (52, "missed")]
    assert story.reports[-1][1].text == "after 1.000 s, joint j0 is 8.59 deg off"


def test_a_plan_ends_only_when_its_goals_have_settled(story, monkeypatch):
    judged_off(story, monkeypatch)
    story.send(2 * PERIOD_NS, "arm", "move", 1.0)
    story.run(end_ns=30 * PERIOD_NS)
    assert story.result.reason == "ended"
    assert story.timed == [(2, "accepted"), (52, "missed")]
