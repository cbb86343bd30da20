"""The table of requests, and what of the lines of `requests/*.txt` is refused or reaches the loop.

Each text is a robot file and, behind `====`, a request a line, whose robot is as at its start:

    POST /rate {"rate": "fast"} => 422 invalid: Expected `float`
    goals pan=0.25 tilt=-0.5                  positions and goals of joints from here on, rad
    POST /controllers/arm/commands/position {"pan": 0.5} => to arm: positions [0.5, -0.5]

That is the HTTP status, the code, and a part of the sentence, or the controller or `loop`, and what it
gets: the kind and the data, which long ones lack.
"""

import json
import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from tests.kit.cases import read_lines
from tests.remote.conftest import TEXTS

from dxlrun.channels.answers import Completion
from dxlrun.remote.gateway import _HANDLERS
from dxlrun.remote.requests.request_table import COMMAND, REGISTER, REQUESTS


@pytest.fixture
def description(desk):
    status, found = desk.ask("GET", "/openapi.json")
    assert status == 200
    return found


def test_each_request_is_answered_and_described(description):
    assert set(_HANDLERS) == set(REQUESTS)
    assert len({(one.method, one.path) for one in REQUESTS}) == len(REQUESTS)
    described = {(method.upper(), path) for path, found in description["paths"].items() for method in found}
    assert described == {(one.method, one.path.replace(":path", "")) for one in REQUESTS}


def test_the_description_is_whole(description):
    assert description["openapi"].startswith("3.1")
    schemas = description["components"]["schemas"]
    for schema in schemas.values():
        Draft202012Validator.check_schema(schema)
    named = set(re.findall(r"#/components/schemas/(\w+)", str(description)))
    assert named == set(schemas)
    switch = description["paths"]["/switch"]["post"]
    assert switch["summary"].startswith("Activate and deactivate controllers")
    parameters = description["paths"]["/controllers/{name}/commands/{kind}"]["post"]["parameters"]
    assert [(one["name"], one["in"]) for one in parameters] == [
        ("name", "path"), ("kind", "path"), ("units", "query"), ("in", "query"), ("goal", "query"),
    ]  # fmt: skip


ASKED = [
    ("GET", "/robot", None, "/robot"),
    ("GET", "/states", None, "/states"),
    ("GET", "/frames", None, "/frames"),
    ("GET", "/log-header", None, "/log-header"),
    ("GET", "/events?after=0", None, "/events"),
    ("GET", "/topics", None, "/topics"),
    ("GET", "/goals", None, "/goals"),
    ("GET", "/joints/pan", None, "/joints/{name}"),
    ("GET", "/controllers/left/parameters", None, "/controllers/{name}/parameters"),
    ("POST", "/controllers/left/commands/go", {"positions": [0.25]}, "/controllers/{name}/commands/{kind}"),
    ("POST", "/controllers/left/set-points/go", {"positions": [1]}, "/controllers/{name}/set-points/{kind}"),
    ("POST", "/switch", {"activate": ["spare"]}, "/switch"),
    ("POST", "/switch", {"activate": ["nun"]}, "/switch"),
    ("POST", "/rate", {"rate": 40}, "/rate"),
]  # fmt: skip


@pytest.mark.parametrize("asked", ASKED, ids=[" ".join(one[:2]) for one in ASKED])
def test_body_and_answer_are_as_described(desk, description, asked):
    method, path, body, pattern = asked
    found = description["paths"][pattern][method.lower()]
    if body is not None:
        check(description, found["requestBody"], body)
    status, answer = desk.ask(method, path, b"" if body is None else body)
    check(description, found["responses"]["2XX" if status < 300 else "default"], answer)


def check(description, content, value):
    (schema,) = (one["schema"] for one in content["content"].values())
    Draft202012Validator({**schema, "components": description["components"]}).validate(value)


def test_names_in_a_path_cannot_leave_their_places():
    assert (
        COMMAND.target("a/../b?", r"\g<0>{kind}")
        == "/controllers/a%2F..%2Fb%3F/commands/%5Cg%3C0%3E%7Bkind%7D"
    )
    assert REGISTER.target("hip/1", "{item}") == "/joints/hip%2F1/registers/%7Bitem%7D"


class Case(NamedTuple):
    """A line of a text, and the goals and positions of joints."""

    file: str
    place: str
    line: str
    states: dict[str, dict[str, float]]


def cases() -> Iterator[Any]:
    for path in sorted(TEXTS.glob("*.txt")):
        states: dict[str, dict[str, float]] = {}
        for place, line, _ in filter(lambda line: line.text, read_lines(path)):
            name, *words = line.split()
            if name in {"goals", "positions"}:
                given = (word.partition("=") for word in words)
                states = states | {name: {joint: float(value) for joint, _, value in given}}
                continue
            yield pytest.param(
                Case(path.name, place, line, states), id=f"{place} {line.partition(' => ')[0][:60]}"
            )


@pytest.mark.parametrize("case", [*cases()])
def test_each_request_is_refused_or_reaches_the_loop_as_written(desk_of: Any, case: Case) -> None:
    line = re.fullmatch(r"(\S+) (\S+) ?(.*) => (?:(\d+) (\w+)|to (\w+)): (.*)", case.line)
    assert line, f"{case.place}: write METHOD PATH BODY => STATUS CODE: SENTENCE, or to NAME: KIND DATA"
    method, path, body, status, code, controller, told = line.groups()
    desk = desk_of(case.file)
    controllers = enumerate(desk.link.plan.loop.controllers)
    desk.record.active = sum(1 << bit for bit, controller in controllers if controller.active)
    arrays = {"goals": desk.record.goals.position, "positions": desk.record.states.position}
    for array in (*desk.record.goals.values, desk.record.states.position):
        array.fill(np.nan)
    rows = {joint.name: row for row, joint in enumerate(desk.link.plan.loop.joints)}
    for name, values in case.states.items():
        for joint, value in values.items():
            arrays[name][rows[joint]] = value
    desk.finish_cycle()
    found, content = desk.ask(method, path, body.encode(), refusal=Completion(-1) if controller else None)
    if controller:
        assert found == 200, f"{case.place}: {content}"
        (taken,) = desk.taken
        kind, _, data = told.partition(" ")
        assert (taken.controller or "loop", taken.kind) == (controller, kind), case.place
        wanted = json.loads(data or "null")
        if isinstance(wanted, list):
            np.testing.assert_allclose(np.frombuffer(taken.data), wanted, atol=1e-6)
        elif wanted is not None:
            assert json.loads(taken.data) == wanted, case.place
        return
    assert (found, content.get("code")) == (int(status), code), f"{case.place}: {content}"
    assert told in content["refused"], f"{case.place}: {content}"
    assert "\n" not in content["refused"]
    assert len(content["refused"]) < 2001
    assert desk.taken == [], f"{case.place}: it reached the loop"
