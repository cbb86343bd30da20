"""Goals and live parameters at the gateway, by ASGI; the test is the loop. No time decides."""

import asyncio
import json
from typing import Annotated, ClassVar

import msgspec
import numpy as np
import pytest
from pydantic import Field, model_validator

import dxlrun
from dxlrun.channels.answers import Code, Completion, Refusal
from dxlrun.channels.event_records import EventBody, EventCode, GoalReport, Severity
from dxlrun.channels.heartbeat import Phase
from dxlrun.channels.topic_messages import PublishedTopic
from dxlrun.control.controllers.goal_registry import GoalStatus as LoopStatus
from dxlrun.control.controllers.plugin_loading import Offer, PlugIns
from dxlrun.control.controllers.published_topics import TopicLog
from dxlrun.messages.declared import declared_message
from dxlrun.remote import gateway
from dxlrun.remote.goal_book import KEPT_GOALS
from dxlrun.remote.preparation import Preparation

GO = "/controllers/left/commands/go"
PARAMETERS = "/controllers/left/parameters"


class Go(dxlrun.CommandModel):
    positions: list[float]


class Gains(dxlrun.ParametersModel):
    p: Annotated[float, Field(ge=0, le=10, description="u/e"), dxlrun.LIVE] = 1.0
    joint: Annotated[dict[str, float], dxlrun.LIVE] = Field({"pan": 0.5})
    d: float = 0.0


class ArmParameters(dxlrun.ParametersModel):
    joints: tuple[str, ...]
    speed: Annotated[dxlrun.AngularVelocity, dxlrun.LIVE] = 1.0
    careful: Annotated[bool, dxlrun.LIVE] = False
    steps: Annotated[int, dxlrun.LIVE] = 3
    gains: Gains = Gains()

    @model_validator(mode="after")
    def _together(self):
        if self.careful and self.speed > 2:
            raise ValueError("a careful arm has a speed of at most 2 rad/s")
        return self


class Arm(dxlrun.Controller[ArmParameters]):
    Parameters = ArmParameters
    Commands: ClassVar = {"go": Go, "nudge": Go}
    Goals: ClassVar = frozenset({"go"})

    @classmethod
    def interfaces(cls, parameters, joints):
        return dxlrun.Interfaces(joints=parameters.joints, command=("position",))

    @classmethod
    def prepare(cls, kind, command, parameters):
        return np.array([parameters.speed, *command.positions])

    def on_goal(self, goal, data, time_ns):
        pass

    def update(self, time_ns, period_ns):
        pass


@pytest.fixture
def arm(desk):
    """The desk, whose controllers take goals and have live parameters."""
    plugins = PlugIns({"arm": Offer("arm", Arm, "tests 1")}, {})
    joints = {joint.name: joint for joint in desk.link.plan.loop.joints}
    desk.gateway._preparation = Preparation(joints, plugins)
    desk.app = desk.gateway.app()
    return desk


def report(desk, number, status, controller="left", **more):
    code = EventCode.GOAL_ACCEPTED if status == "accepted" else EventCode.GOAL_ENDED
    data = msgspec.json.encode(GoalReport(number, controller, "go", "anna", status, **more))
    desk.events.emit_event(controller, EventBody(code, Severity.INFO, f"goal {number} {status}"), data)
    desk.link.collect_messages()


def accept(desk, number):
    """Let the loop accept the next command as a goal."""
    real = desk.mailbox.answer_command
    desk.mailbox.answer_command = lambda command, _: (
        report(desk, number, "accepted"),
        real(command, Completion(7, goals=(number,))),
    )


def test_the_answer_to_a_goal_has_its_number_and_the_goal_is_known_at_once(arm):
    accept(arm, 4)
    assert arm.ask("POST", GO, {"positions": [0.25]}) == (200, {"done": True, "cycle": 7, "goals": [4]})
    status, goal = arm.ask("GET", "/goals/4")
    assert (status, goal["status"], goal["controller"], goal["kind"]) == (200, "running", "left", "go")
    assert arm.ask("GET", "/robot")[1]["controllers"][0]["goals"] == ["go"]


def test_a_result_is_kept_and_listed(arm):
    report(arm, 1, "accepted")
    arm.link.goals.take_message({"goal": 1, "status": "running", "progress": 0.25, "error": 0.01}, 1.0)
    arm.link.goals.take_message({"goal": 1, "status": "running", "progress": "half"}, 1.0)
    arm.link.goals.take_message({"goal": 7, "status": "running", "progress": 0.5}, 1.0)
    assert arm.ask("GET", "/goals")[1]["running"][0]["progress"] == 0.25
    report(arm, 1, "missed", text="too slow", joint="pan", error=0.02)
    report(arm, 2, "accepted")
    _, found = arm.ask("GET", "/goals")
    assert [goal["goal"] for goal in found["running"]] == [2]
    (ended,) = found["ended"]
    assert (ended["status"], ended["text"], ended["joint"], ended["error"]) == (
        "missed",
        "too slow",
        "pan",
        0.02,
    )
    assert ended["ended"] >= ended["accepted"]


def test_progress_is_that_of_the_topic(arm):
    topic = PublishedTopic("/goals", declared_message(LoopStatus, "dxlrun_msgs").type)
    publisher = TopicLog(arm.record, arm.messages).open("/goals", LoopStatus)
    assert publisher.topic == topic
    report(arm, 1, "accepted")
    for progress in (0.1, 0.2, 0.3):
        publisher.publish(LoopStatus(goal=1, status="running", progress=progress))
    arm.link.collect_messages()
    goal = arm.ask("GET", "/goals/1")[1]
    assert (goal["progress"], goal["error"]) == (0.3, None)
    publisher.publish(LoopStatus(goal=1, status="running", progress=0.4, error=0.02))
    arm.link.collect_messages()
    (goal,) = arm.ask("GET", "/goals")[1]["running"]
    assert (goal["progress"], goal["error"]) == (0.4, 0.02)


def test_as_many_results_are_kept_as_there_is_room_for(arm):
    for number in range(1, KEPT_GOALS + 51):
        report(arm, number, "accepted")
        report(arm, number, "reached")
    assert len(arm.link.goals.ended) == KEPT_GOALS
    status, answer = arm.ask("GET", "/goals/3")
    assert (status, answer["code"]) == (409, "goal_ended")
    assert arm.ask("GET", f"/goals/{KEPT_GOALS + 50}")[1]["progress"] == 1.0


def test_a_client_waits_for_the_end_of_a_goal(arm):
    report(arm, 1, "accepted")

    async def waits():
        waiting = [asyncio.ensure_future(arm.request("GET", "/goals/1?wait=5")) for _ in range(2)]
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert not any(one.done() for one in waiting)
        report(arm, 1, "reached")
        for _ in range(20):
            await asyncio.sleep(0)
        assert all(one.done() for one in waiting), "they wait for their time, not for the goal"
        return [one.result() for one in waiting]

    for status, goal in asyncio.run(waits()):
        assert (status, goal["status"]) == (200, "reached")


def test_a_wait_ends_when_its_time_is_over(arm):
    report(arm, 1, "accepted")
    assert arm.ask("GET", "/goals/1?wait=0.01")[1]["status"] == "running"


def test_a_wait_at_the_end_of_the_run_is_refused_and_a_result_that_came_is_told(arm, monkeypatch):
    monkeypatch.setattr(gateway, "_ENDING_S", 0.01)
    report(arm, 1, "accepted")
    arm.heartbeat.enter_phase(Phase.STOPPING)
    assert arm.ask("GET", "/goals/1?wait=5")[1]["code"] == "run_ending"
    report(arm, 1, "aborted", text="the run ended")
    assert arm.ask("GET", "/goals/1?wait=5")[1]["text"] == "the run ended"


@pytest.mark.parametrize(
    ("path", "data"),
    [
        ("/goals/3/cancel", {"goal": 3, "controller": ""}),
        ("/controllers/left/cancel", {"goal": 0, "controller": "left"}),
    ],
)
def test_a_cancel_reaches_the_loop(arm, path, data):
    report(arm, 3, "accepted")
    assert arm.ask("POST", path) == (200, {"done": True, "cycle": 0, "goals": [3]})
    (taken,) = arm.taken
    assert (taken.controller, taken.kind, json.loads(taken.data)) == ("", "cancel", data)


def test_what_the_loop_refuses_of_a_cancel_is_passed_on(arm):
    refusal = Refusal(Code.GOAL_ENDED, {"goal": 3, "outcome": "reached"})
    status, answer = arm.ask("POST", "/goals/3/cancel", refusal=refusal)
    assert (status, answer["refused"]) == (409, "goal 3 has ended already: reached")
    assert arm.ask("POST", "/controllers/lefty/cancel")[1]["code"] == "unknown_controller"
    assert arm.ask("POST", "/goals/x/cancel")[0] == 422


def test_a_goal_is_not_streamed(arm):
    status, answer = arm.ask("POST", "/controllers/left/set-points/go", {"positions": [0]})
    assert (status, answer["code"]) == (422, "goal_streamed")
    assert arm.ask("POST", "/controllers/left/set-points/nudge", {"positions": [0]})[0] == 202


def rows(desk):
    return {row["name"]: row for row in desk.ask("GET", PARAMETERS)[1]["parameters"]}


def test_parameters_are_shown_with_their_values_as_in_the_file(arm):
    found = rows(arm)
    assert {name: row["value"] for name, row in found.items()} == {
        "joints": ["pan"],
        "speed": "1.0 rad/s",
        "careful": False,
        "steps": 3,
        "gains.p": 1.0,
        "gains.joint.pan": 0.5,
        "gains.d": 0.0,
    }
    assert [name for name, row in found.items() if not row["live"]] == ["joints", "gains.d"]
    assert (found["gains.p"]["range"], found["gains.p"]["description"]) == ("at least 0, at most 10", "u/e")


def test_live_parameters_are_checked_and_changed_together(arm):
    values = {"speed": "90 deg/s", "gains.p": 4, "careful": True, "gains.joint.pan": 2}
    status, answer = arm.ask("POST", PARAMETERS, {"values": values})
    assert status == 200
    (taken,) = arm.taken
    assert json.loads(taken.data) == {
        "controller": "left",
        "values": {"speed": np.pi / 2, "careful": True, "gains.p": 4.0, "gains.joint.pan": 2.0},
    }
    assert {"name": "gains.p", "old": 1.0, "new": 4.0} in answer["changed"]
    assert rows(arm)["speed"]["value"] == f"{np.pi / 2!r} rad/s"
    accept(arm, 1)
    arm.ask("POST", GO, {"positions": [0.25]})
    assert np.frombuffer(arm.taken[-1].data)[0] == np.pi / 2


@pytest.mark.parametrize(
    ("values", "status", "code", "sentence"),
    [
        ({"gains.p": 40}, 422, "invalid", "left.gains.p is 40, but must be at most 10"),
        ({"gains.p": float("nan")}, 422, "invalid", "JSON is malformed"),
        ({"gains.p": ".nan"}, 422, "invalid", "must be a number"),
        ({"gains.p": "nan"}, 422, "invalid", "must be a finite number"),
        ({"gains.p": "fast"}, 422, "invalid", "must be a number"),
        ({"speed": 1.0}, 422, "invalid", "has no unit"),
        ({"speed": "3 rad/s", "careful": True}, 422, "invalid", "careful arm has a speed of at most 2"),
        ({"steps": 1.5}, 422, "invalid", "steps"),
        ({"gains.d": 1.0}, 422, "not_live", "gains.d of left cannot be changed in a run; live are speed"),
        ({"joints": "tilt"}, 422, "not_live", "joints of left cannot be changed in a run"),
        ({"sped": 1.0}, 404, "unknown_parameter", "left has no parameter sped; did you mean speed?"),
        ({"gains": 1.0}, 404, "unknown_parameter", "name one of its values: gains.p, gains.joint.pan"),
        ({"gains.joint.tilt": 1.0}, 404, "unknown_parameter", "left has no parameter gains.joint.tilt"),
        ({"gains.p.x": 1.0}, 404, "unknown_parameter", "left has no parameter gains.p.x"),
        ({}, 422, "invalid", "nothing to change"),
        ({"gains.p": None}, 422, "invalid", "write for example"),
    ],
)  # fmt: skip
def test_wrong_parameters_are_refused_whole_and_never_reach_the_loop(arm, values, status, code, sentence):
    before = rows(arm)
    body = json.dumps({"values": {"steps": 4} | values if values else {}}).encode()
    found, answer = arm.ask("POST", PARAMETERS, body)
    assert (found, answer["code"]) == (status, code), answer
    assert sentence in answer["refused"]
    assert arm.taken == []
    assert rows(arm) == before


def test_what_the_loop_refuses_changes_nothing(arm):
    refusal = Refusal(Code.CONTROLLER_FAULT, {"problem": "controller left raised"})
    before = rows(arm)
    assert arm.ask("POST", PARAMETERS, {"values": {"steps": 4}}, refusal=refusal)[0] == 409
    assert rows(arm) == before


def test_a_controller_that_is_loaded_anew_has_the_parameters_of_its_entry(arm):
    entry = {"name": "more", "type": "arm", "joints": ["pan"]}
    arm.ask("POST", "/controllers", entry)
    arm.ask("POST", "/controllers/more/parameters", {"values": {"steps": 8}})

    def steps():
        found = arm.ask("GET", "/controllers/more/parameters")[1]["parameters"]
        return {row["name"]: row["value"] for row in found}["steps"]

    assert steps() == 8
    arm.ask("DELETE", "/controllers/more")
    arm.ask("POST", "/controllers", entry)
    assert steps() == 3


# What does not arrive


def published(arm, **fields):
    TopicLog(arm.record, arm.messages).open("/goals", LoopStatus).publish(LoopStatus(**fields))
    arm.link.collect_messages()


def statuses(arm):
    _, found = arm.ask("GET", "/goals")
    return {goal["goal"]: goal["status"] for goal in (*found["running"], *found["ended"])}


def test_an_end_whose_event_is_lost_is_known_from_the_topic(arm):
    report(arm, 1, "accepted")
    published(arm, goal=1, controller="left", status="missed", error=0.02, joint="pan", text="too slow")
    _, goal = arm.ask("GET", "/goals/1")
    assert (goal["status"], goal["joint"], goal["text"]) == ("missed", "pan", "too slow")
    assert goal["ended"] is not None
    report(arm, 1, "accepted")  # what comes late changes nothing
    assert statuses(arm) == {1: "missed"}


def test_a_goal_whose_beginning_was_lost_is_known_from_the_topic(arm):
    published(arm, goal=3, controller="left", kind="go", origin="anna", status="accepted")
    _, goal = arm.ask("GET", "/goals/3")
    assert (goal["status"], goal["controller"], goal["kind"], goal["origin"]) == (
        "running",
        "left",
        "go",
        "anna",
    )


def test_a_goal_whose_end_is_lost_has_ended_when_its_controller_has_the_next(arm):
    report(arm, 1, "accepted")
    report(arm, 2, "accepted", controller="right")
    report(arm, 3, "accepted")
    assert statuses(arm) == {1: "preempted", 2: "running", 3: "running"}
    assert "the log has it" in arm.ask("GET", "/goals/1")[1]["text"]


@pytest.mark.parametrize(
    ("path", "refusal", "status"),
    [
        ("/goals/1/cancel", Refusal(Code.GOAL_ENDED, {"goal": 1, "outcome": "reached"}), "reached"),
        ("/goals/1/cancel", Refusal(Code.GOAL_ENDED, {"goal": 1, "outcome": "long ago"}), "aborted"),
        ("/controllers/left/cancel", Refusal(Code.NO_GOAL, {"controller": "left"}), "aborted"),
        ("/goals/1/cancel", Refusal(Code.CANCELLED_ALREADY, {"goal": 1}), "running"),
    ],
)
def test_a_goal_whose_end_is_lost_has_ended_when_the_loop_says_so(arm, path, refusal, status):
    report(arm, 1, "accepted")
    assert arm.ask("POST", path, refusal=refusal)[0] == 409
    assert statuses(arm) == {1: status}


def test_after_lost_events_a_goal_of_a_controller_that_is_not_active_has_ended(arm):
    report(arm, 1, "accepted")
    report(arm, 2, "accepted", controller="right")
    for _ in range(3000):
        arm.events.emit_event("x", EventBody(EventCode.GUARDIAN, Severity.INFO, "x" * 400))
    arm.record.active = 0b001
    while arm.record.woken_ns < 8_000_000_000:  # later than the goals' beginnings
        arm.finish_cycle()
    arm.link.collect_messages()
    assert statuses(arm) == {1: "running", 2: "aborted"}


def test_without_lost_events_a_goal_runs_until_its_end_is_reported(arm):
    report(arm, 1, "accepted")
    arm.record.active = 0
    arm.finish_cycle()
    arm.link.collect_messages()
    assert statuses(arm) == {1: "running"}


def test_of_a_change_the_range_of_what_is_wrong_is_named_and_no_other(arm):
    _, answer = arm.ask("POST", PARAMETERS, {"values": {"gains.p": 40, "steps": 3}})
    assert answer["refused"].endswith("(gains.p: at least 0, at most 10)")
    _, answer = arm.ask("POST", PARAMETERS, {"values": {"gains.p": 4, "steps": 1.5}})
    assert "gains.p" not in answer["refused"]


class Derived(ArmParameters):
    half: Annotated[float, dxlrun.LIVE] = 0.5

    @model_validator(mode="before")
    @classmethod
    def _halved(cls, values):
        return {**values, "half": values.get("steps", 3) / 2}


def test_a_live_parameter_that_follows_from_another_changes_with_it(arm, monkeypatch):
    monkeypatch.setattr(Arm, "Parameters", Derived)
    assert arm.ask("POST", PARAMETERS, {"values": {"steps": 8}})[0] == 200
    assert json.loads(arm.taken[-1].data)["values"] == {"steps": 8, "half": 4.0}


class Labelled(Derived):
    label: Annotated[str, dxlrun.LIVE] = "left"


def test_a_live_parameter_that_is_no_number_is_named_and_keeps_no_other_from_changing(arm, monkeypatch):
    monkeypatch.setattr(Arm, "Parameters", Labelled)
    assert arm.ask("POST", PARAMETERS, {"values": {"steps": 8}})[0] == 200
    status, answer = arm.ask("POST", PARAMETERS, {"values": {"label": "right"}})
    assert status == 422
    assert "label = 'right' cannot change in a run; only numbers and bools can" in answer["refused"]
