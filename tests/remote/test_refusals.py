"""Requests that the gateway refuses before they reach the loop: the cases of `refusals/*.txt`.

Each text is a robot file and, behind `====`, a request a line, with what is answered:

    POST /rate {"rate": "fast"} => 422 invalid: Expected `float`

That is the HTTP status, the code, and a part of the sentence. The type `arm` is that of `conftest.py`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from tests.remote.conftest import Arm

from dxlrun.compile import robot_compiler
from dxlrun.control.controllers.plugin_loading import Offer, PlugIns, load_plugins
from dxlrun.plan.robot_plan import Plan
from dxlrun.testing import plan_of

TEXTS = Path(__file__).with_name("refusals")


@cache
def plugins() -> PlugIns:
    offers = {**load_plugins().controllers, "arm": Offer("arm", Arm, "tests 1")}
    return PlugIns(offers, {}, drivers=load_plugins().drivers)


@pytest.fixture(scope="module")
def plan_in(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return the plan of a text's robot, compiled once."""

    @cache
    def compiled(name: str) -> Plan:
        file = tmp_path_factory.mktemp("refused") / "robot.yaml"
        file.write_text((TEXTS / name).read_text("utf-8").partition("====\n")[0])
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(robot_compiler, "load_plugins", lambda **_: plugins())
            return plan_of(file)

    return compiled


class Case(NamedTuple):
    """A line of a text."""

    file: str
    place: str
    line: str


def cases() -> Iterator[Any]:
    for path in sorted(TEXTS.glob("*.txt")):
        lines = path.read_text("utf-8").splitlines()
        first = lines.index("====") + 1
        for number, line in enumerate(lines[first:], first + 1):
            place = f"{path.name}:{number}"
            yield pytest.param(Case(path.name, place, line), id=f"{place} {line.partition(' => ')[0][:60]}")


@pytest.mark.parametrize("case", [*cases()])
def test_a_wrong_request_is_refused_with_one_sentence(desk_of: Any, plan_in: Any, case: Case) -> None:
    line = re.fullmatch(r"(\S+) (\S+) ?(.*) => (\d+) (\w+): (.*)", case.line)
    assert line, f"{case.place}: write METHOD PATH BODY => STATUS CODE: SENTENCE"
    desk = desk_of(plan_in(case.file), plugins())
    controllers = enumerate(desk.link.plan.loop.controllers)
    desk.record.active = sum(1 << bit for bit, controller in controllers if controller.active)
    for array in (*desk.record.goals.values, desk.record.states.position):
        array.fill(float("nan"))
    desk.finish_cycle()
    status, content = desk.ask(line[1], line[2], line[3].encode())
    assert (status, content.get("code")) == (int(line[4]), line[5]), f"{case.place}: {content}"
    assert line[6] in content["refused"], f"{case.place}: {content}"
    assert "\n" not in content["refused"]
    assert len(content["refused"]) < 2001
    assert desk.taken == [], f"{case.place}: it reached the loop"
