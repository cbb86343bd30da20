"""The order of updates: by the graph, else by the file; circles are named."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dxlrun.control.controllers.update_order import (
    UpdateEdge,
    above,
    below,
    circles,
    drawn,
    edges,
    update_order,
)


@dataclass(frozen=True)
class Node:
    name: str
    into: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    provides: tuple[str, ...] = ()


def test_a_reader_of_a_reference_is_updated_after_all_that_command_it():
    nodes = [
        Node("watch", reads=("pid/elbow/position", "elbow/velocity")),
        Node("pid"),
        Node("left", ("pid",)),
        Node("right", ("pid",)),
    ]
    assert edges(nodes) == (
        UpdateEdge("left", "pid"),
        UpdateEdge("right", "pid"),
        UpdateEdge("left", "watch"),
        UpdateEdge("right", "watch"),
    )
    assert update_order(nodes) == ("left", "right", "watch", "pid")


def test_an_upper_controller_may_read_what_it_commands():
    nodes = [Node("pid", reads=("pid/elbow/position",)), Node("arm", ("pid",), ("pid/elbow/position",))]
    assert update_order(nodes) == ("arm", "pid")


def test_two_that_read_what_the_other_commands_are_a_circle():
    nodes = [Node("pid"), Node("a", ("pid",), ("pid/x/effort",)), Node("b", ("pid",), ("pid/y/effort",))]
    assert circles(nodes) == (("a", "b"),)


def test_every_circle_is_drawn_at_once():
    nodes = [
        Node("x", ("x",)),
        Node("c", ("a",)),
        Node("a", ("b",)),
        Node("b", ("c",)),
        Node("p", ("q",)),
        Node("q", ("p", "a")),
    ]
    assert circles(nodes) == (("x",), ("c", "a", "b"), ("p", "q"))
    with pytest.raises(ValueError, match=r"circle: x -> x; c -> a -> b -> c; p -> q -> p$"):
        update_order(nodes)


def test_what_is_above_and_below_goes_through_others():
    nodes = [Node("pid"), Node("arm", ("limiter",)), Node("limiter", ("pid", "gone")), Node("head")]
    assert above(nodes, "pid") == ("limiter", "arm")
    assert below(nodes, "arm") == ("limiter", "pid")
    assert above(nodes, "gone") == ("limiter", "arm")  # also of one that is not among them
    assert above(nodes, "arm") == below(nodes, "pid") == above(nodes, "head") == ()


NAMES = "abcdef"
nodes_of_any_graph = st.lists(
    st.tuples(
        st.lists(st.sampled_from(NAMES), max_size=2, unique=True),
        st.lists(st.sampled_from(NAMES), max_size=1),
    ),
    max_size=len(NAMES),
).map(
    lambda found: [
        Node(name, tuple(into), tuple(f"{owner}/joint/position" for owner in reads))
        for name, (into, reads) in zip(NAMES, found, strict=False)
    ]
)


@settings(deadline=None)
@given(nodes_of_any_graph)
def test_the_order_is_the_first_of_all_that_the_edges_allow(nodes):
    """Against brute force: every permutation, in the order of the file."""
    pairs = [(edge.before, edge.after) for edge in edges(nodes)]
    allowed = (
        order
        for order in permutations(node.name for node in nodes)
        if all(order.index(before) < order.index(after) for before, after in pairs)
    )
    first = next(allowed, None)
    if first is None:
        with pytest.raises(ValueError, match="in a circle"):
            update_order(nodes)
    else:
        assert circles(nodes) == ()
        assert update_order(nodes) == first


@settings(deadline=None)
@given(nodes_of_any_graph)
def test_what_is_called_a_circle_is_one_and_without_its_edges_none_is_left(nodes):
    left = {(edge.before, edge.after) for edge in edges(nodes)}
    for circle in circles(nodes):
        steps = set(zip(circle, (*circle[1:], circle[0]), strict=True))
        assert steps <= left, drawn(circle)
        assert circle[0] == min(circle)
        left -= steps
    while left:  # take away what nothing leads to, again and again
        ends = {after for _, after in left}
        rest = {(before, after) for before, after in left if before in ends}
        assert rest != left
        left = rest
