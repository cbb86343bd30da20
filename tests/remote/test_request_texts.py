"""Requests to the gateway, and what is refused of them or reaches the loop: the lines of `requests/*.txt`.

Each text is a robot file and, behind `====`, a request a line:

    POST /rate {"rate": "fast"} => 422 invalid: Expected `float`
    goals pan=0.25 tilt=-0.5
    POST /controllers/arm/commands/position {"pan": 0.5} => to arm: positions [0.5, -0.5]

That is the HTTP status, the code, and a part of the sentence, or what the loop gets: the controller or
`loop`, the kind, and its array or JSON. `goals` and `positions` are those of the joints in the following
lines, rad; they are not known before. The types `arm` and `whole` are of `conftest.py`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest
from tests.kit.cases import read_lines
from tests.remote.conftest import TEXTS, plugins

from dxlrun.channels.answers import Completion


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
def test_each_request_is_refused_or_reaches_the_loop_as_written(
    desk_of: Any, plan_in: Any, case: Case
) -> None:
    line = re.fullmatch(r"(\S+) (\S+) ?(.*) => (?:(\d+) (\w+)|to (\w+)): (.*)", case.line)
    assert line, f"{case.place}: write METHOD PATH BODY => STATUS CODE: SENTENCE, or to NAME: KIND DATA"
    method, path, body, status, code, controller, told = line.groups()
    desk = desk_of(plan_in(case.file), plugins())
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
        wanted = json.loads(data)
        if isinstance(wanted, list):
            np.testing.assert_allclose(np.frombuffer(taken.data), wanted, atol=1e-6)
        else:
            assert json.loads(taken.data) == wanted, case.place
        return
    assert (found, content.get("code")) == (int(status), code), f"{case.place}: {content}"
    assert told in content["refused"], f"{case.place}: {content}"
    assert "\n" not in content["refused"]
    assert len(content["refused"]) < 2001
    assert desk.taken == [], f"{case.place}: it reached the loop"
