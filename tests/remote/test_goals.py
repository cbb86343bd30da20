"""Goals and live parameters at the gateway: waits, lost events, memory; the rest is in sessions/goals.txt."""

import asyncio
import json
from typing import Annotated

import msgspec
import pytest
from pydantic import model_validator
from tests.remote.conftest import GoalArm, GoalParameters

import dxlrun
from dxlrun.channels.event_records import EventBody, EventCode, GoalReport, Severity
from dxlrun.channels.heartbeat import Phase
from dxlrun.remote import gateway
from dxlrun.remote.goal_book import KEPT_GOALS

PARAMETERS = "/controllers/left/parameters"


@pytest.fixture
def arm(desk_of):
    """A desk whose controllers take goals and have live parameters."""
    return desk_of("../sessions/goals.txt")


def report(desk, number, status, controller="left", **more):
    code = EventCode.GOAL_ACCEPTED if status == "accepted" else EventCode.GOAL_ENDED
    data = msgspec.json.encode(GoalReport(number, controller, "go", "anna", status, **more))
    desk.events.emit_event(controller, EventBody(code, Severity.INFO, f"goal {number} {status}"), data)
    desk.link.collect_messages()


def test_feedback_that_is_none_changes_nothing(arm):
    report(arm, 1, "accepted")
    arm.link.goals.take_message({"goal": 1, "status": "running", "progress": "half"}, 1.0)
    assert arm.ask("GET", "/goals/1")[1]["progress"] == 0.0


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


def test_a_wait_at_the_end_of_the_run_is_refused_and_a_result_that_came_is_told(arm, monkeypatch):
    monkeypatch.setattr(gateway, "_ENDING_S", 0.01)
    report(arm, 1, "accepted")
    arm.heartbeat.enter_phase(Phase.STOPPING)
    assert arm.ask("GET", "/goals/1?wait=5")[1]["code"] == "run_ending"
    report(arm, 1, "aborted", text="the run ended")
    assert arm.ask("GET", "/goals/1?wait=5")[1]["text"] == "the run ended"


def statuses(arm):
    _, found = arm.ask("GET", "/goals")
    return {goal["goal"]: goal["status"] for goal in (*found["running"], *found["ended"])}


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


class Derived(GoalParameters):
    half: Annotated[float, dxlrun.LIVE] = 0.5

    @model_validator(mode="before")
    @classmethod
    def _halved(cls, values):
        return {**values, "half": values.get("steps", 3) / 2}


def test_a_live_parameter_that_follows_from_another_changes_with_it(arm, monkeypatch):
    monkeypatch.setattr(GoalArm, "Parameters", Derived)
    assert arm.ask("POST", PARAMETERS, {"values": {"steps": 8}})[0] == 200
    assert json.loads(arm.taken[-1].data)["values"] == {"steps": 8, "half": 4.0}


class Labelled(Derived):
    label: Annotated[str, dxlrun.LIVE] = "left"


def test_a_live_parameter_that_is_no_number_is_named_and_keeps_no_other_from_changing(arm, monkeypatch):
    monkeypatch.setattr(GoalArm, "Parameters", Labelled)
    assert arm.ask("POST", PARAMETERS, {"values": {"steps": 8}})[0] == 200
    status, answer = arm.ask("POST", PARAMETERS, {"values": {"label": "right"}})
    assert status == 422
    assert "label = 'right' cannot change in a run; only numbers and bools can" in answer["refused"]
