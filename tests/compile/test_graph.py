"""The controller graph in the file: every mistake at its line and column, all at once."""

from __future__ import annotations

import re

import pytest
from tests.kit.pages import page_text
from tests.kit.robots import compile_text, problems_in, robot_text

from dxlrun.compile.controller_graph import ControllerGraph, GraphEdge
from dxlrun.plan.loop_plan import ControllerPlan

pytestmark = pytest.mark.usefixtures("part_plugins")

ROBOT = robot_text("controllers")
GOOD = """\
  arm: {type: part, joints: [shoulder, elbow], command: [position, velocity], into: limiter, rate: 25}
  watch: {type: part, reads: [wrist/temperature, arm_pid/elbow/position]}
  limiter:
    type: part
    joints: [elbow, shoulder]
    command: [position, velocity]
    exports: [position, velocity]
    into: [arm_pid]
    rate: 50
  arm_pid: {type: part, joints: [shoulder, elbow], command: [effort], exports: [position, velocity, effort]}
  feed: {type: part, joints: [elbow], command: [effort], into: arm_pid}
  hand: {type: part, joints: [wrist], command: [position], fallback: still}
  still: {type: part, joints: [wrist], command: [position], active: false}
"""


def test_a_right_graph_has_no_problem_and_its_order():
    loop = compile_text(ROBOT + GOOD).plan.loop

    graph = ControllerGraph(joints=("shoulder", "elbow", "wrist"), controllers=loop.controllers)
    assert graph.order == ("arm", "limiter", "feed", "watch", "arm_pid", "hand", "still")
    assert [edge for edge in graph.edges if edge.joint == "elbow" and edge.kind != "command"] == [
        GraphEdge("reference", "arm", "limiter", "elbow", ("position", "velocity")),
        GraphEdge("read", "arm_pid", "watch", "elbow", ("position",)),
        GraphEdge("reference", "limiter", "arm_pid", "elbow", ("position", "velocity")),
        GraphEdge("reference", "feed", "arm_pid", "elbow", ("effort",)),
    ]
    assert GraphEdge("command", "arm_pid", "shoulder", "shoulder", ("effort",)) in graph.edges
    assert GraphEdge("read", "wrist", "watch", "wrist", ("temperature",)) in graph.edges


def test_the_chain_of_the_page_is_right():
    page = page_text("robot-file.md")
    (chain,) = [text for text in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL) if "into:" in text]
    assert problems_in(ROBOT.replace("controllers:\n", "") + chain) == ()


@pytest.mark.parametrize(
    ("reads", "warned"),
    [
        ("arm_pid/elbow/position", ""),  # which limiter commands
        ("limiter/shoulder/position", "its own command of the previous cycle"),
        ("elbow/position", ""),
    ],
)
def test_a_controller_that_reads_what_it_commands_is_warned_about(reads: str, warned: str) -> None:
    arm = "into: limiter, rate: 25}"
    assert arm in GOOD
    text = ROBOT + GOOD.replace(arm, f"into: limiter, rate: 25, reads: [{reads}]}}")
    if reads.startswith("arm_pid"):
        text = text.replace("into: limiter, rate: 25, ", "active: false, ")
    compiled = compile_text(text)
    found = [one for one in compiled.warnings if reads in one.what]
    assert [one.what for one in found] == ([f"arm reads {reads}, {warned}"] if warned else [])
    assert [one.fix for one in found] == (
        ["read the state shoulder/position, or remove this entry"] if warned else []
    )


def test_a_controller_that_reads_itself_is_warned_about_and_can_be_ordered() -> None:
    low = ControllerPlan(
        "low",
        "part",
        "",
        "{}",
        ("j",),
        ("effort",),
        (),
        True,
        1,
        reference=("position",),
        reads=("low/j/position",),
    )
    filter_ = ControllerPlan(
        "filter", "part", "", "{}", (), (), (), True, 1, reads=("filter/x", "filter/age"), provides=("x",)
    )
    graph = ControllerGraph(("j",), (low, filter_))
    assert [*graph.find_mistakes()] == []
    assert graph.order == ("low", "filter")
    assert [one.what for one in graph.warnings()] == [
        "low reads low/j/position, its own reference",
        "filter reads filter/x, its own state of the previous cycle",
    ]


def test_a_mistake_has_its_path_in_the_file() -> None:
    plan = ControllerPlan("up", "part", "", "{}", ("j",), ("position",), (), True, 1, into=("low",))
    (mistake,) = ControllerGraph(("j",), (plan,)).find_mistakes()
    assert mistake.at == ("controllers", "up", "into", 0)
    assert mistake.what == "`into` of up names an unknown controller low"
