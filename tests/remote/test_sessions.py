"""What clients ask of the gateway in turn, what is answered, and what reaches the loop: `sessions/*.txt`.

The texts have the form of `tests/kit/cases.py`; the head is a robot file. Lines of a case, in order:

    POST /rate {"rate": 100} => 200 {"done": true}    a part of the answer; `...` stands for any text
    GET /goals/9 => 404 unknown_goal: no goal 9       code, and a part of the sentence
    took loop rate {"rate": 100.0}                    the next command that the loop got: JSON, or an array
    took nothing                                      no further command
    play arm pan: {position: 0 rad} => 200            a motion with one point: its controller and joints

What is not a request happens to the robot: see `HAPPENINGS`. Commands are done as the loop does them, or
answered as `loop answers` has it: a completion, or a refusal with its code.
"""

import json
import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.kit.cases import TextCase, case_parameters, fits, place_of, read_form
from tests.remote.conftest import Desk

from dxlrun.channels.answers import Code, Completion, Refusal
from dxlrun.channels.event_records import EventBody, EventCode, GoalReport, Severity
from dxlrun.channels.heartbeat import Phase
from dxlrun.control.controllers.goal_registry import GoalStatus
from dxlrun.control.controllers.published_topics import TopicLog
from dxlrun.plan.loop_plan import ServoLimit


def is_part(wanted: Any, found: Any) -> bool:
    """Check whether an answer has what is wanted of it."""
    match wanted:
        case dict():
            return isinstance(found, dict) and all(
                key in found and is_part(value, found[key]) for key, value in wanted.items()
            )
        case list():
            return len(wanted) == len(found) and all(map(is_part, wanted, found))
        case str() if "..." in wanted:
            return fits(found, wanted)
        case float():
            return bool(found == pytest.approx(wanted, abs=1e-6))
    return bool(wanted == found)


class Session:
    """A desk, and the words that happen to its robot."""

    def __init__(self, desk: Desk) -> None:
        self.desk, self.answer = desk, None
        self.plan = desk.link.plan.loop

    def request(self, method: str, path: str, body: str, status: str, told: str) -> None:
        found, content = self.desk.ask(method, path, body.encode(), refusal=self.answer)
        assert found == int(status), content
        if told and not told.startswith("{"):
            code, _, sentence = told.partition(": ")
            assert (content["code"], sentence in content["refused"]) == (code, True), content
        elif told:
            assert is_part(json.loads(told), content), content

    def play(self, controller: str, joints: str, status: str, told: str) -> None:
        points = f"points: [{{time: 0 s, joints: {{{joints}}}}}]"
        text = f"name: nod\nmotions:\n  - controller: {controller}\n    {points}\n"
        self.request("POST", "/play", json.dumps({"file": "wave.yaml", "text": text}), status, told)

    def took(self, controller: str, kind: str, data: str) -> None:
        taken = self.desk.taken.pop(0)
        assert (taken.controller or "loop", taken.kind) == (controller, kind), taken
        if data.startswith("["):
            np.testing.assert_allclose(np.frombuffer(taken.data), json.loads(data), atol=1e-6)
        else:
            assert not data or is_part(json.loads(data), json.loads(taken.data.partition(b"\n")[0])), taken

    def took_nothing(self) -> None:
        assert self.desk.taken == []

    def answers(self, text: str) -> None:
        values = json.loads(text)
        if "code" in values:
            self.answer = Refusal(Code(values["code"]), values.get("fields", {}))
        else:
            self.answer = Completion(values.pop("cycle", 0), **values) if values else None

    def report_goal(self, number: str, status: str, controller: str, more: str | None) -> None:
        code = EventCode.GOAL_ACCEPTED if status == "accepted" else EventCode.GOAL_ENDED
        report = GoalReport(int(number), controller, "go", "anna", status, **json.loads(more or "{}"))
        self.emit("", code.name, controller, f"goal {number} {status}", msgspec.json.encode(report))

    def publish(self, fields: str) -> None:
        TopicLog(self.desk.record, self.desk.messages).open("/goals", GoalStatus).publish(
            GoalStatus(**json.loads(fields))
        )
        self.desk.link.collect_messages()

    def emit(self, guardian: str, code: str, source: str, text: str, data: bytes = b"") -> None:
        ring = self.desk.guardian_events if guardian else self.desk.events
        ring.emit_event(source, EventBody(EventCode[code.upper()], Severity.INFO, text), data)
        self.desk.link.collect_messages()

    def limit(self, joint: str, interface: str, most: str, text: str) -> None:
        data = msgspec.json.encode((ServoLimit(interface, float(most), text),))
        self.emit("", "servo_limits", joint, "", data)

    def show(self, name: str, values: str) -> None:
        record = self.desk.record
        array = {
            "goal": record.goals.position,
            "source_commands": record.source_commands,
            "sources": record.sources.values,
            "source_age": record.sources.age_ns,
            "source_valid": record.sources.valid,
        }.get(name)
        array = getattr(record.states, name) if array is None else array
        array[:] = [float(one) for one in values.split()]
        self.desk.finish_cycle()

    def activate(self, names: str) -> None:
        bits = {controller.name: 1 << bit for bit, controller in enumerate(self.plan.controllers)}
        self.desk.record.active = sum(bits[name] for name in names.split())
        self.desk.finish_cycle()

    def enter(self, phase: str) -> None:
        self.desk.heartbeat.enter_phase(Phase[phase.upper()])


HAPPENINGS = {
    r"play (\w+) (.*?) => (\d+) ?(.*)": Session.play,
    r"took nothing": Session.took_nothing,
    r"took (\w+) (\w+) ?(.*)": Session.took,
    r"loop answers (\{.*\})": Session.answers,  # {}: as it does by itself
    r"goal (\d+) (\w+) of (\w+)(?: (\{.*\}))?": Session.report_goal,
    r"topic (\{.*\})": Session.publish,
    r"(guardian )?event (\w+) (\w+): (.*)": Session.emit,
    r"register of (\w+): (\w+) (\S+), (.*)": Session.limit,
    r"(\w+): ([-\d. na]+)": Session.show,  # values of the record; then a cycle ends
    r"active:(.*)": Session.activate,
    r"phase (\w+)": Session.enter,
    r"(GET|POST|DELETE) (\S+) ?(.*?) => (\d+) ?(.*)": Session.request,
}


@pytest.mark.parametrize("case", case_parameters(Path(__file__).with_name("sessions")))
def test_session(desk_of: Any, case: TextCase) -> None:
    session = Session(desk_of(f"../sessions/{case.file.name}"))
    session.activate(" ".join(one.name for one in session.plan.controllers if one.active))
    for array in (*session.desk.record.goals.values, session.desk.record.states.position):
        array.fill(math.nan)
    for line in case.lines:
        with place_of(line):
            read_form(HAPPENINGS, line.text)(session)
