"""Claims: what two controllers may not have both, what leaves and enters; and the order of updates."""

import random
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.kit.loops import plan_of

from dxlrun.control.controllers.claims import ControllerSnapshot, SwitchStep, conflicts, conflicts_text
from dxlrun.control.controllers.update_order import (
    UpdateEdge,
    above,
    below,
    circles,
    drawn,
    edges,
    lowers_first,
    update_order,
)
from dxlrun.plan.loop_plan import ControllerPlan


def wants(name: str, joints: Any, command: Any = ("position",), **more: Any) -> ControllerPlan:
    exports = {"reference": ("position", "effort")}
    return plan_of(name, joints=joints, command=command, **exports | more)


def test_each_pair_that_claims_the_same_joints_is_named_once():
    found = conflicts(
        [wants("left", ("a", "b", "c")), wants("right", ("d",)), wants("whole", tuple("abcde"))]
    )
    assert conflicts_text(found) == (
        "controllers left and whole both command joint a and 2 more; "
        "controllers right and whole both command joint d"
    )


def test_a_command_of_a_device_is_claimed_once():
    one, two = (wants(name, (), (), source_commands=("light/led",)) for name in ("one", "two"))
    (found,) = conflicts([one, two, wants("three", (), (), source_commands=("light/buzzer",))])
    assert (found.holder, found.other) == ("one", "two")
    assert "light/led" in str(found)


def test_a_joint_is_claimed_at_the_one_that_exports_it():
    lower = [wants("left", ("a",)), wants("spare", ("a",), command=()), wants("right", ("b", "c"))]
    first = wants("first", ("a", "b"), into=("left", "right"))
    assert not conflicts([*lower, first, wants("second", ("a", "c"), into=("spare", "right"))])
    (found,) = conflicts([*lower, first, wants("second", ("a", "b"), into=("spare", "right"))])
    assert found.reference == "right/b/position"


# Steps: what leaves and what enters, among any controllers


def claims(name: str, *joints: str, into: tuple[str, ...] = (), exports: bool = False) -> ControllerPlan:
    return plan_of(name, joints=joints, into=into, reference=("position",) if exports else (), active=False)


def graph(draw: random.Random) -> dict[str, ControllerPlan]:
    """Return controllers of which some are into one that exports all of their joints."""
    known: dict[str, ControllerPlan] = {}
    for index in range(draw.randint(3, 8)):
        lowers = [one for one in known.values() if one.reference]
        into: tuple[str, ...] = ()
        joints = draw.sample("abc", draw.randint(1, 3))
        if lowers and draw.random() < 0.5:
            lower = draw.choice(lowers)
            into, joints = (lower.name,), draw.sample(lower.joints, draw.randint(1, len(lower.joints)))
        known[f"c{index}"] = claims(f"c{index}", *joints, into=into, exports=draw.random() < 0.5)
    return known


def without(active: dict[str, ControllerPlan], leave: tuple[str, ...]) -> dict[str, ControllerPlan]:
    return {name: one for name, one in active.items() if name not in leave}


def test_what_is_active_afterwards_claims_nothing_twice_and_chains_are_whole():
    for seed in range(300):
        draw = random.Random(seed)
        known = graph(draw)
        active: dict[str, ControllerPlan] = {}
        for _ in range(12):
            names = draw.sample(sorted(known), draw.randint(1, 2))
            step = ControllerSnapshot(known, active).request(names)
            if not isinstance(step, SwitchStep):
                needed = [known[name] for name in lowers_first(names, known)]
                assert conflicts(needed), "only what claims the same is refused"
                continue
            assert not set(step.leave) & set(step.enter)
            entering = [known[name] for name in step.enter]
            active = without(active, step.leave) | {one.name: one for one in entering}
            assert set(names) <= active.keys()
            assert not conflicts(active.values())
            assert all(lower in active for one in active.values() for lower in one.into)
            for name in step.leave:  # none leaves that could have stayed
                lowers = [lower for lower in known[name].into if lower in step.leave]
                assert lowers or conflicts([known[name], *entering])
            if draw.random() < 0.3 and active:
                leaving = ControllerSnapshot(known, active).switch((), [draw.choice(sorted(active))])
                if isinstance(leaving, SwitchStep):
                    active = without(active, leaving.leave)


ALL = {
    one.name: one
    for one in (
        claims("low", "a", exports=True),
        claims("high", "a", into=("low",)),
        claims("other", "a"),
        claims("rest", "a"),
        claims("on_low", "a", into=("low",)),
        claims("twice", "a", "b", into=("low", "mate")),
        claims("mate", "a", "b", exports=True),
        claims("stray", "a", into=("gone",)),
    )
}


def takes_over(fallback: str, active: str = "", waiting: str = "", failed: tuple[str, ...] = ()) -> object:
    """Return how a fallback takes over for `high`."""
    engaged = [{name: ALL[name] for name in names.split()} for names in (active, waiting)]
    return ControllerSnapshot(ALL, *engaged).fall_back(fallback, ["high"], failed)


@pytest.mark.parametrize(
    ("fallback", "active", "waiting", "failed"),
    [
        ("rest", "rest", "", ()),  # it is active already
        ("rest", "", "rest", ()),  # or will be
        ("rest", "other", "", ()),  # one that goes on holds its joint
        ("twice", "low", "", ()),  # what it is into would have to leave
        ("stray", "", "", ()),  # what it is into was unloaded
        ("on_low", "", "", ("low",)),  # what it is into has failed
        ("rest", "", "", ("rest",)),  # it has failed itself
        ("on_low", "", "low", ()),  # what it is into is not there yet
    ],
)
def test_a_fallback_that_cannot_take_over_is_none(fallback, active, waiting, failed):
    assert takes_over(fallback, active, waiting, failed) is None


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
