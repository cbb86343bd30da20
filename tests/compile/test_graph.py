"""The controller graph: its order, its edges, and what the page has of it; `cases/` has its mistakes."""

from __future__ import annotations

import re

import pytest
from msgspec.structs import replace
from tests.kit.pages import page_text
from tests.kit.robots import compile_text, problems_in, robot_text

from dxlrun.compile.controller_graph import ControllerGraph, GraphEdge
from dxlrun.plan.loop_plan import ControllerPlan

pytestmark = pytest.mark.usefixtures("part_plugins")


def test_right_graph_has_its_order_and_its_edges():
    loop = compile_text(robot_text("graph")).plan.loop
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
    assert problems_in(robot_text("controllers").replace("controllers:\n", "") + chain) == ()


def test_controller_that_reads_itself_is_warned_about_and_can_be_ordered() -> None:
    plan = ControllerPlan("low", "part", "", "{}", ("j",), ("effort",), (), True, 1)
    low = replace(plan, reference=("position",), reads=("low/j/position",))
    own = replace(
        plan, name="filter", joints=(), command=(), reads=("filter/x", "filter/age"), provides=("x",)
    )
    graph = ControllerGraph(("j",), (low, own))
    assert [*graph.find_mistakes()] == []
    assert graph.order == ("low", "filter")
    assert [one.what for one in graph.warnings()] == [
        "low reads low/j/position, its own reference",
        "filter reads filter/x, its own state of the previous cycle",
    ]
