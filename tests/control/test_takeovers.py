"""Requests of controllers: which take over in the same cycle, what is refused, and how a run is ended."""

from __future__ import annotations

import random

import numpy as np
import pytest
from tests.kit.loops import PERIOD_NS, Robot, on_update, plan_of

from dxlrun.channels.cycle import Torque
from dxlrun.channels.event_records import EventCode
from dxlrun.control.controllers.claims import ControllerSnapshot, SwitchStep, conflicts
from dxlrun.control.controllers.update_order import lowers_first
from dxlrun.plan.loop_plan import ControllerPlan
from dxlwire.modes import Mode

SPARE = {"active": False}
EXPORTS = {"reference": ("position",)}


class Story(Robot):
    """Controllers that command a number of their own, and a watch that makes its request in cycle 3."""

    def controller(self, name, value, request=None, **options):
        """`request` is called with the context in cycle 3."""

        def act(context, time_ns, _):
            if value is not None:
                given = context.references.position
                context.commands.position[:] = given if len(given) and np.isfinite(given).all() else value
            if request and round(time_ns / PERIOD_NS) == 3:
                request(context)

        return self.script(name, on_update(act), **{"command": ("position",)} | options)

    def watched(self, request, takeovers=("safe",)):
        """Run eight cycles with a watch that makes a request."""
        self.controller("watch", None, request, joints=(), command=(), takeovers=takeovers)
        self.run(8)
        return self

    def commanded(self, cycle):
        return self.sink.cycles[cycle]["position"].tolist()


@pytest.fixture
def story():
    return Story()


def falls(context):
    context.take_over(["safe"], "it falls")


def test_a_controller_takes_over_in_the_cycle_of_the_request_wherever_it_stands(story):
    story.controller("safe", 0.5, **SPARE).controller("walk", 0.1).watched(falls)
    assert [story.active(cycle) for cycle in (2, 3)] == [["walk", "watch"], ["safe", "watch"]]
    assert [story.commanded(cycle) for cycle in (2, 3)] == [[0.1, 0.1], [0.5, 0.5]]
    assert story.steps("safe") == [3, 4, 5, 6, 7]
    assert story.steps("watch") == list(range(8))
    assert story.events.of(EventCode.TAKEOVER) == [("watch", "safe takes over from walk: it falls")]
    assert story.result.reason == "stopped"


def test_only_those_that_command_the_same_leave_and_all_above_them(story):
    story.controller("head", 0.2, joints=("j1",)).controller("upper", 0.3, joints=("j0",), into=("lower",))
    story.controller("lower", 0.0, joints=("j0",), **EXPORTS)
    story.controller("safe", 0.5, joints=("j0",), **SPARE).watched(falls)
    assert story.active(3) == ["head", "safe", "watch"]
    assert [story.commanded(cycle) for cycle in (2, 3)] == [[0.3, 0.2], [0.5, 0.2]]


@pytest.mark.parametrize(
    ("walk", "soft", "cycle"),
    [({}, SPARE, 3), ({"into": ("soft",)}, {}, 4)],  # a cycle later: the one below was updated already
    ids=["those below enter too", "those below stay"],
)
def test_one_above_takes_over_with_those_below_it(story, walk, soft, cycle):
    story.controller("walk", 0.1, **walk).controller("safe", 0.5, into=("soft",), **SPARE)
    story.controller("soft", 0.0, **EXPORTS, **soft).watched(falls)
    assert story.active(3) == ["safe", "soft", "watch"]
    assert story.commanded(cycle) == [0.5, 0.5]


def test_what_is_active_already_is_left_alone(story):
    story.controller("safe", 0.5).watched(falls)
    assert not story.events.of(EventCode.TAKEOVER)
    assert not story.events.of(EventCode.COMMAND_REFUSED)
    assert story.order("activate") == ["safe", "watch"]


@pytest.mark.parametrize(("unloaded", "what"), [(False, "j1"), (True, "safe")])
def test_a_joint_without_torque_or_one_that_was_unloaded_refuses_it_and_all_stays(story, unloaded, what):
    def limp(context):
        story.record.states.torque[1] = Torque.OFF
        falls(context)

    story.controller("walk", 0.1)
    if not unloaded:
        story.controller("safe", 0.5, **SPARE)
    story.watched(limp)
    ((source, text),) = story.events.of(EventCode.COMMAND_REFUSED)
    assert source == "watch"
    assert "takeover by safe refused" in text
    assert what in text
    assert "it falls" in text
    assert story.active(7) == ["walk", "watch"]


def test_a_controller_that_was_not_declared_is_a_fault_of_the_one_that_requests_it(story):
    story.controller("safe", 0.5, **SPARE).watched(falls, takeovers=("other",))
    assert story.result.reason == "fault"
    assert "watch requested a takeover by safe; add safe to its takeovers" in story.result.detail


def test_the_one_that_requests_leaves_where_it_commands_the_same(story):
    story.controller("walk", 0.1, falls, takeovers=("safe",)).controller("safe", 0.5, **SPARE).run(8)
    assert (story.active(3), story.commanded(3)) == (["safe"], [0.5, 0.5])


def test_a_request_of_one_that_entered_counts_in_the_same_cycle_and_a_circle_ends(story):
    def back(context):
        context.take_over(["walk"], "back")

    story.controller("walk", 0.1, falls, takeovers=("safe",))
    story.controller("safe", 0.5, back, takeovers=("walk",), **SPARE).run(8)
    texts = story.events.texts(EventCode.TAKEOVER)
    assert texts[:2] == ["safe takes over from walk: it falls", "walk takes over from safe: back"]
    assert story.result.reason == "stopped"


def test_a_fault_in_the_same_update_takes_the_request_along(story):
    def broken(context):
        falls(context)
        raise RuntimeError("broken")

    story.controller("safe", 0.5, **SPARE).controller("walk", 0.1).watched(broken)
    assert not story.events.of(EventCode.TAKEOVER)
    assert "broken" in story.result.detail


def test_joints_in_another_mode_come_first(story):
    story.controller("safe", 0.5, command=("effort",), **SPARE).controller("walk", 0.1).watched(falls)
    assert story.active(3) == ["watch"]
    assert story.active(4) == ["safe", "watch"]  # the double's servos change their modes at once
    assert story.hardware.asked[-1] == [Mode.EFFORT] * 2


def test_takeover_over_a_lower_controller_that_waits_for_its_mode_is_refused(story):
    story.controller("soft", 0.0, command=("effort",), reference=("position",), **SPARE)
    story.controller("safe", 0.5, into=("soft",), **SPARE)
    story.controller("watch", None, falls, joints=(), command=(), takeovers=("safe",)).build()
    story.hardware.mode_cycles = lambda: 4
    story.run(10, {2: story.switches(["soft"])})
    why = "takeover by safe refused: soft is not active yet; wait until its joints have changed their modes"
    assert story.events.texts(EventCode.COMMAND_REFUSED) == [f"{why} (requested because: it falls)"]
    assert story.active(9) == ["soft", "watch"]
    assert story.order("activate") == ["watch", "soft"]


def test_a_controller_ends_the_run_by_the_policy_for_faults(story):
    story.controller("walk", 0.1).watched(lambda context: context.end_run("the battery is empty"))
    assert story.result.reason == "fault"
    assert story.result.detail == "controller watch ended the run: the battery is empty"
    assert story.result.cycles == 4


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


def test_a_fallback_takes_over_from_those_below_the_one_that_failed():
    assert takes_over("rest", "low", failed=("high",)) == SwitchStep(("low",), ("rest",))
    assert takes_over("on_low", "low", failed=("high",)) == SwitchStep((), ("on_low",))


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
