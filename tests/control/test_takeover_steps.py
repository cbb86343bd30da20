"""Takeovers among random controllers: what is active afterwards claims nothing twice; chains are whole."""

from __future__ import annotations

import random

import pytest

from dxlrun.control.controllers.claims import Step, conflicts, request_step, switch_step, takeover_step
from dxlrun.control.controllers.graph import lowers_first
from dxlrun.plan.loop_plan import ControllerPlan

JOINTS = ("a", "b", "c")


def plan(name: str, joints: tuple[str, ...], into: tuple[str, ...], exports: bool) -> ControllerPlan:
    return ControllerPlan(
        name=name,
        type="any",
        distribution="tests 1",
        parameters="{}",
        joints=joints,
        command=("position",),
        publishes=(),
        active=False,
        every=1,
        into=into,
        reference=("position",) if exports else (),
    )


def graph(draw: random.Random) -> dict[str, ControllerPlan]:
    """Return controllers of which some are into one that exports all of their joints."""
    known: dict[str, ControllerPlan] = {}
    for index in range(draw.randint(3, 8)):
        lowers = [one for one in known.values() if one.reference]
        into: tuple[str, ...] = ()
        joints = tuple(draw.sample(JOINTS, draw.randint(1, 3)))
        if lowers and draw.random() < 0.5:
            lower = draw.choice(lowers)
            into, joints = (lower.name,), tuple(draw.sample(lower.joints, draw.randint(1, len(lower.joints))))
        known[f"c{index}"] = plan(f"c{index}", joints, into, draw.random() < 0.5)
    return known


def whole(active: dict[str, ControllerPlan]) -> bool:
    return all(lower in active for one in active.values() for lower in one.into)


def test_what_is_active_afterwards_fits_together() -> None:
    for seed in range(300):
        take_over_at_random(random.Random(seed))


def take_over_at_random(draw: random.Random) -> None:
    known = graph(draw)
    active: dict[str, ControllerPlan] = {}
    for _ in range(12):
        names = draw.sample(sorted(known), draw.randint(1, 2))
        step = request_step(names, known, active, {})
        if not isinstance(step, Step):
            needed = [known[name] for name in lowers_first(names, known)]
            assert conflicts(needed), "only what claims the same is refused"
            continue
        assert not set(step.leave) & set(step.enter)
        kept = {name: one for name, one in active.items() if name not in step.leave}
        after = kept | {name: known[name] for name in step.enter}
        assert set(names) <= after.keys()
        assert not conflicts(after.values())
        assert whole(after)
        for name in step.leave:  # none leaves that could have stayed
            lowers = [lower for lower in known[name].into if lower in step.leave]
            assert lowers or conflicts([known[name], *(known[one] for one in step.enter)])
        active = after
        if draw.random() < 0.3 and active:
            leaving = switch_step((), [draw.choice(sorted(active))], known, active, {})
            if isinstance(leaving, Step):
                active = {name: one for name, one in active.items() if name not in leaving.leave}


LOW = plan("low", ("a",), (), True)
HIGH = plan("high", ("a",), ("low",), False)
OTHER = plan("other", ("a",), (), False)
REST = plan("rest", ("a",), (), False)
ON_LOW = plan("on_low", ("a",), ("low",), False)
TWICE = plan("twice", ("a", "b"), ("low", "mate"), False)
MATE = plan("mate", ("a", "b"), (), True)
STRAY = plan("stray", ("a",), ("gone",), False)
ALL = {one.name: one for one in (LOW, HIGH, OTHER, REST, ON_LOW, TWICE, MATE, STRAY)}


def known(*names: str) -> dict[str, ControllerPlan]:
    return {name: ALL[name] for name in names}


def test_a_fallback_takes_over_from_those_below_the_one_that_failed() -> None:
    assert takeover_step("rest", ["high"], ALL, known("low"), {}, ["high"]) == Step(("low",), ("rest",))
    assert takeover_step("on_low", ["high"], ALL, known("low"), {}, ["high"]) == Step((), ("on_low",))


@pytest.mark.parametrize(
    ("fallback", "active", "waiting", "failed"),
    [
        ("rest", ("rest",), (), ()),  # it is active already
        ("rest", (), ("rest",), ()),  # or will be
        ("rest", ("other",), (), ()),  # one that goes on holds its joint
        ("twice", ("low",), (), ()),  # what it is into would have to leave
        ("stray", (), (), ()),  # what it is into was unloaded
        ("on_low", (), (), ("low",)),  # what it is into has failed
        ("rest", (), (), ("rest",)),  # it has failed itself
        ("on_low", (), ("low",), ()),  # what it is into is not there yet
    ],
)
def test_a_fallback_that_cannot_take_over_is_none(
    fallback: str, active: tuple[str, ...], waiting: tuple[str, ...], failed: tuple[str, ...]
) -> None:
    step = takeover_step(fallback, ["high"], ALL, known(*active), known(*waiting), failed)
    assert step is None
