"""Chains in switches and faults: what enters and leaves together, what is refused, which fallback comes."""

from __future__ import annotations

import numpy as np
import pytest
from tests.kit.loops import PERIOD_NS, Robot, on_update

from dxlrun.channels.answers import Acceptance, Code, Completion
from dxlrun.channels.cycle import Clamp, Torque
from dxlrun.channels.event_records import EventCode
from dxlrun.errors import ControllerFault

NAN = np.nan
TOP, UPPER = {"into": ("middle",)}, {"into": ("lower",)}
LOWER = {"reference": ("position",)}
MIDDLE = LOWER | UPPER
OFF = {"active": False}
EFFORT = {"command": ("effort",)}


class Story(Robot):
    """A robot whose controllers pass their references on, or command values of their own, `own`."""

    def __init__(self, joints=2):
        super().__init__(joints)
        self.own = {}

    def controller(self, name, own=None, **options):
        options = {"command": ("position",)} | options
        self.own[name] = own

        def act(context, *_):
            value = self.own.get(name)
            for interface in options["command"]:
                mine, given = getattr(context.commands, interface), getattr(context.references, interface)
                if value is not None:
                    mine[:] = value
                elif np.isfinite(given).any():
                    np.copyto(mine, given)

        return self.script(name, on_update(act), **options)

    def chain(self, *, active=True, **upper):
        """Add `lower`, and `upper`, which is into it and commands 0.4."""
        self.controller("lower", active=active, **LOWER)
        return self.controller("upper", 0.4, active=active, **UPPER, **upper)

    def three(self, **options):
        """Add `top` into `middle` into `lower`, in this order."""
        self.controller("top", **TOP, **options).controller("middle", **MIDDLE, **options)
        return self.controller("lower", **LOWER, **options)

    def ends(self, *active, reason="ended", after=3):
        """Check how the run ended, and what was active in a cycle."""
        expected = {"ended": "stopped"}.get(reason, reason)
        assert (self.result.reason, self.active(after)) == (expected, list(active))

    def reference(self, cycle):
        return self.sink.cycles[cycle]["reference"].tolist()


@pytest.fixture
def story():
    return Story()


def commanded(controller, upper, hint):
    return Code.COMMANDED, {"controller": controller, "upper": upper, "hint": hint}


# Switches


def test_the_lower_end_enters_with_the_upper_one_first(story):
    story.chain(active=False).run(6, {2: story.switches(["upper"])})
    assert [story.active(cycle) for cycle in (1, 2)] == [[], ["lower", "upper"]]
    assert story.order("activate") == ["lower", "upper"]
    assert story.answer() == Completion(2)
    assert story.column("position", 0)[2] == 0.4


def test_a_lower_end_that_is_active_stays_as_it_is(story):
    story.controller("lower", **LOWER).controller("upper", **UPPER, **OFF)
    story.run(6, {2: story.switches(["upper"])})
    assert story.order("activate") == ["lower", "upper"]
    assert story.active(2) == ["lower", "upper"]


@pytest.mark.parametrize("active", [True, False])
def test_three_in_a_chain_enter_from_the_bottom_and_leave_from_the_top(story, active):
    story.three(active=active).run(4, {} if active else {1: story.switches(["top"])})
    assert story.order("activate") == ["lower", "middle", "top"]
    assert story.order("deactivate") == ["top", "middle", "lower"]


def test_run_ends_with_upper_controllers_first_and_the_last_in_the_file_before_others(story):
    story.controller("upper", joints=("j0",), **UPPER).controller("lower", joints=("j0",), **LOWER)
    story.controller("beside", joints=("j1",)).run(4)
    assert story.order("deactivate") == ["beside", "upper", "lower"]


@pytest.mark.parametrize(
    ("activate", "deactivate", "upper_active"),
    [((), ("lower",), True), (("lower",), ("lower",), True), (("upper",), ("lower",), False)],
    ids=["left", "restarted alone", "taken from one that enters"],
)
def test_the_lower_end_is_not_taken_from_the_upper_one(story, activate, deactivate, upper_active):
    story.controller("lower", **LOWER).controller("upper", active=upper_active, **UPPER)
    story.run(6, {2: story.switches(activate, deactivate)})
    assert story.answer() == commanded("lower", "upper", "deactivate upper in the same switch")
    assert story.active(5) == ["lower", "upper"][: 1 + upper_active]


def test_both_ends_leave_together_the_upper_one_first(story):
    story.chain().run(6, {2: story.switches((), ["lower", "upper"])})
    assert story.active(2) == []
    assert story.order("deactivate") == ["upper", "lower"]


def test_a_chain_begins_anew_together(story):
    story.chain().run(6, {2: story.switches(["upper"], ["lower", "upper"])})
    assert story.answer() == Completion(2)
    assert story.active(2) == ["lower", "upper"]
    assert story.order("activate") == ["lower", "upper"] * 2


def test_the_upper_end_leaves_alone_and_the_lower_one_has_no_references(story):
    story.chain().run(6, {3: story.switches((), ["upper"]), 4: story.posts("lower", "p")})
    assert story.active(3) == ["lower"]
    assert story.reference(2) == [0.4, 0.4]
    assert np.isnan(story.reference(3)).all()
    assert story.answer(2) == Completion(4), "and takes commands"


def test_another_one_takes_over_the_references_in_one_cycle(story):
    story.chain().controller("next", -0.2, **UPPER, **OFF).run(8, {4: story.switches(["next"], ["upper"])})
    assert story.column("reference", 0) == [0.4] * 4 + [-0.2] * 4


def test_two_commanders_of_one_reference_are_refused(story):
    story.chain().controller("next", joints=("j1",), **UPPER, **OFF).run(6, {2: story.switches(["next"])})
    conflict = "controllers upper and next both command lower/j1/position"
    fields = {"conflict": conflict, "joints": ("j1",), "holders": ("upper",), "others": ("next",)}
    assert story.answer() == (Code.JOINTS_CLAIMED, fields)


def test_a_chain_is_refused_where_its_lower_end_would_claim_a_taken_servo_or_takes_its_place(story):
    story.chain(active=False).controller("direct", 0.1, joints=("j1",))
    story.run(6, {2: story.switches(["upper"]), 3: story.switches(["upper"], ["direct"])})
    code, fields = story.answer()
    taken = "controllers direct and lower both command joint j1"
    assert (code, fields["conflict"]) == (Code.JOINTS_CLAIMED, taken)
    assert [story.active(cycle) for cycle in (2, 3)] == [["direct"], ["lower", "upper"]]
    assert story.column("position", 1) == [0.1] * 3 + [0.4] * 3


def test_a_command_for_one_that_is_commanded_is_refused(story):
    story.chain().send(PERIOD_NS, "lower", "position", 0.1, 0.1)
    story.run(6, {2: story.posts("lower", "position")})
    assert story.answer() == commanded("lower", "upper", "command upper, or deactivate it")
    assert "command" not in [call.step for call in story.calls]
    assert "lower is commanded by upper" in story.events.texts(EventCode.COMMAND_REFUSED)[0]


@pytest.mark.parametrize(("enters", "stale"), [(2, 0), (6, 1)], ids=["in time", "when it is held already"])
def test_a_stream_of_the_lower_end_ends_when_the_upper_one_enters(story, enters, stale):
    story.controller("lower", **LOWER).controller("upper", 0.4, **UPPER, **OFF)
    story.run(9, {1: story.posts("lower", "p", b"", 3 * PERIOD_NS), enters: story.switches(["upper"])})
    assert len(story.events.of(EventCode.STALE_COMMAND)) == stale
    assert story.column("position", 0)[-1] == 0.4


def test_a_stale_stream_of_the_upper_end_takes_its_references_back(story):
    story.chain().run(8, {2: story.posts("upper", "p", b"", PERIOD_NS)})
    assert len(story.events.of(EventCode.STALE_COMMAND)) == 1
    assert np.isnan(story.reference(7)).all()
    assert story.active(7) == ["lower", "upper"]
    assert (story.steps("lower")[-1], story.steps("upper")[-1]) == (7, 7), "both go on, the lower one holds"


def test_the_upper_end_is_held_while_a_joint_of_the_lower_one_is_lost():
    story = Story(joints=3).controller("lower", **LOWER).controller("upper", 0.4, joints=("j0",), **UPPER)
    story.controller("beside", joints=("j1",), command=()).build()
    states = story.record.states

    def answers(yes):
        states.valid[2], states.age_ns[2] = yes, 0 if yes else 10**9

    story.run(20, {4: lambda: answers(False), 12: lambda: answers(True)})
    assert story.column("reference", 0) == [0.4] * 20
    assert [len(story.steps(name)) for name in ("lower", "upper")] == [20, 20]
    told = [(name, text.partition(":")[0]) for name, text in story.events.of(EventCode.POLICY)]
    until = "is held until all its joints answer again"
    assert told == [("lower", until), ("upper", until), ("lower", "resumes"), ("upper", "resumes")]


# Faults


def test_a_fault_of_the_upper_end_without_a_fallback_ends_the_run(story):
    story.chain().run(8, {3: story.breaks("upper")})
    story.ends("lower", reason="fault")
    assert story.result.detail.startswith("controller upper raised in update: RuntimeError: broken (")
    assert np.isnan(story.reference(3)).all()


def test_a_nan_in_a_reference_is_the_fault_of_the_upper_end_and_never_reaches_the_lower_one(story):
    story.chain(fallback="hold").controller("hold", 0.2, **UPPER, **OFF)
    story.run(8, {3: lambda: story.own.update(upper=[0.4, NAN])})
    why = "controller upper commanded lower/j1/position = nan after a finite value"
    assert story.events.of(EventCode.CONTROLLER_FAULT) == [("upper", why)]
    story.ends("lower", "hold", after=4)
    assert not (story.sink.cycles[3]["clamped"] & Clamp.NOT_FINITE).any()
    values = story.column("reference", 1)
    assert (values[:3], values[4:]) == ([0.4] * 3, [0.2] * 4)


def test_an_infinite_reference_is_a_fault_at_once(story):
    story.chain().own["upper"] = np.inf
    assert "commanded lower/j0/position = inf" in story.run(3).detail


def test_a_fault_of_the_lower_end_takes_all_above_out_and_its_fallback_takes_over(story):
    story.controller("top", 0.4, **UPPER).controller("lower", fallback="still", **LOWER)
    story.controller("still", 0.1, **OFF).run(8, {3: story.breaks("lower")})
    story.ends("still")
    assert story.order("deactivate")[0] == "top"
    assert story.column("position", 0)[3] == 0.1
    assert np.isnan(story.reference(3)).all()


@pytest.mark.parametrize("step", ["update", "command"])
def test_the_lower_end_leaves_where_the_fallback_claims_its_servos(story, step):
    story.chain(fallback="still").controller("still", joints=("j1",), **OFF)
    story.run(8, {3: [story.breaks("upper", step), story.posts("upper", "p")]})
    story.ends("still")
    assert story.order("deactivate")[0] == "lower"


def test_the_lower_end_stays_where_the_fallback_goes_into_it(story):
    story.chain(fallback="still").controller("still", 0.2, **UPPER, **OFF).run(8, {3: story.breaks("upper")})
    story.ends("lower", "still", after=4)
    assert story.order("activate").count("lower") == 1
    assert story.column("position", 0)[4] == 0.2


def test_the_lower_end_stays_where_the_fallback_claims_none_of_its_servos():
    story, both = Story(joints=3), {"joints": ("j0", "j1")}
    story.controller("lower", **both, **LOWER).controller("upper", fallback="beside", **both, **UPPER)
    story.controller("beside", joints=("j2",), **OFF).run(8, {3: story.breaks("upper")})
    story.ends("lower", "beside")


def test_a_fallback_does_not_take_servos_from_a_lower_end_that_another_one_uses(story):
    story.controller("lower", **LOWER).controller("left", joints=("j0",), fallback="still", **UPPER)
    story.controller("right", joints=("j1",), **UPPER).controller("still", joints=("j0",), **OFF)
    story.run(8, {3: story.breaks("left")})
    story.ends("lower", "right", reason="fault")


@pytest.mark.parametrize(
    ("broken", "fallbacks", "others", "active", "left"),
    [
        # the nearest one above takes over where the broken one has no fallback
        ("lower", {"top": "far", "middle": "near"}, {"far": OFF, "near": OFF}, ["near"], ["top", "middle"]),
        # a fallback that would need the broken one is passed over
        ("lower", {"middle": "needs", "top": "still"}, {"needs": UPPER | OFF, "still": OFF}, ["still"], None),
        # all in between leave with the lower end whose servos the fallback claims
        ("top", {"top": "still"}, {"still": OFF}, ["still"], ["middle", "lower"]),
        # a middle one is replaced at the bottom
        ("middle", {"middle": "hold"}, {"hold": UPPER | OFF}, ["lower", "hold"], ["top"]),
    ],
)
def test_which_fallback_takes_over_in_a_chain_of_three(broken, fallbacks, others, active, left):
    story = Story()
    for name, place in (("top", TOP), ("middle", MIDDLE), ("lower", LOWER)):
        story.controller(name, fallback=fallbacks.get(name, ""), **place)
    for name, options in others.items():
        story.controller(name, **options)
    story.run(8, {3: story.breaks(broken)})
    story.ends(*active)
    assert left is None or story.order("deactivate")[: len(left)] == left


@pytest.mark.parametrize("limp", [["j0"], ["j0", "j1"]])
def test_fallback_of_a_limp_joint_leaves_the_fault_to_the_next_fallback_or_to_the_policy(limp):
    story = Story(joints=3).controller("lower", joints=("j2",), fallback="near", **LOWER)
    story.controller("upper", joints=("j2",), fallback="far", **UPPER)
    story.controller("near", joints=("j0",), **OFF).controller("far", joints=("j1",), **OFF).build()
    for joint in limp:
        story.record.states.torque[story.names.index(joint)] = Torque.OFF
    story.run(8, {3: story.breaks("lower")})
    refused = [text.split(";")[0] for text in story.events.texts(EventCode.COMMAND_REFUSED)]
    both = ["near cannot take over: j0 is limp", "far cannot take over: j1 is limp"]
    assert refused == both[: len(limp)]
    story.ends(*(["far"] if len(limp) == 1 else []), reason="ended" if len(limp) == 1 else "fault")


def test_a_lower_end_that_fails_to_activate_keeps_the_upper_one_out(story):
    story.chain(active=False, fallback="still").controller("still", **OFF)
    story.breaks("lower", "activate")()
    story.run(6, {2: story.switches(["upper"])})
    assert "upper" not in story.order("activate")
    story.ends("still")
    code, fields = story.answer()
    assert (code, fields["controller"]) == (Code.CONTROLLER_FAULT, "lower")
    assert (
        "upper is not activated: its lower controller lower"
        in story.events.texts(EventCode.COMMAND_REFUSED)[0]
    )


def test_an_upper_end_that_fails_to_activate_leaves_the_lower_one_holding(story):
    story.chain(active=False, fallback="calm").controller("calm", **UPPER, **OFF)
    story.breaks("upper", "activate")()
    story.run(6, {2: story.switches(["upper"])})
    story.ends("lower", "calm")


def test_a_fallback_of_a_lower_end_that_fails_as_it_is_taken_over_comes_after_all_have_entered():
    """Its fallback claims a servo of another one that enters in the same switch: that one has it."""
    story, both = Story(joints=3), {"joints": ("j0", "j1")}
    story.controller("lower", fallback="greedy", **both, **LOWER).controller("upper", **both, **UPPER, **OFF)
    story.controller("beside", joints=("j2",), **OFF).controller("greedy", **OFF)

    def fails_to_follow():
        def follow():
            raise ControllerFault("controller lower raised in on_cancel")

        story.manager._named["lower"].follow_upper = follow

    story.run(8, {3: [fails_to_follow, story.switches(["upper", "beside"])]})
    story.ends("beside", reason="fault")


def parameters_break(story, name):
    """Return a request of live parameters that a controller raises at."""

    def request():
        def on_parameters(time_ns):
            raise RuntimeError("broken")

        story.manager._named[name].controller.on_parameters = on_parameters
        story.ask("parameters", controller=name, values={})

    return request


def test_an_inactive_one_that_fails_takes_no_command_from_the_one_that_has_its_joints(story):
    story.controller("slow", 0.3, every=4).controller("spare", **OFF)
    story.run(8, {6: parameters_break(story, "spare")})
    assert story.answer()[0] == Code.CONTROLLER_FAULT
    assert story.column("position", 0) == [0.3] * 8


def test_two_fallbacks_that_fail_in_turn_end_the_run(story):
    story.chain(fallback="still").controller("still", fallback="upper", **OFF)
    assert story.run(9, {3: story.breaks("upper"), 5: story.breaks("still")}).reason == "fault"


def test_the_gate_names_the_chain_whose_command_it_cuts(story):
    story.chain().own["upper"] = 3.0
    story.run(60)
    cut = "j0, controller lower, commanded by upper: goal lowered to the upper position limit"
    assert cut in story.events.texts(EventCode.GATE)


# Modes


def effort_chain(cycles, stubborn=()):
    """Return a robot whose joints need so many cycles for the mode of a chain beside `direct`."""
    story = Story().controller("direct").controller("lower", reference=("effort",), **EFFORT, **OFF)
    return slow(story.controller("upper", 0.1, joints=("j0",), **EFFORT, **UPPER, **OFF), cycles, stubborn)


def slow(story, cycles, stubborn=()):
    story.build()
    story.hardware.mode_cycles, story.hardware.stubborn = (lambda: cycles), stubborn
    return story


def test_a_chain_enters_together_when_the_modes_of_its_lower_end_are_there():
    story, answers = effort_chain(3), []
    keep = story.inbox.answer_command
    story.inbox.answer_command = lambda number, answer: (answers.append(answer), keep(number, answer))
    story.run(12, {2: story.switches(["upper"], ["direct"])})
    states = [story.active(cycle) for cycle in range(8)]
    entered = states.index(["lower", "upper"])
    assert states[:entered] == [["direct"]] * 2 + [[]] * (entered - 2)
    assert entered > 4
    assert answers == [Acceptance(("lower", "upper")), Completion(entered)]


def test_while_a_chain_waits_neither_end_can_be_taken_from_the_other():
    story = Story().controller("direct").controller("lower", reference=("effort",), **EFFORT, **OFF)
    for name, joint in (("upper", "j0"), ("second", "j1")):
        story.controller(name, joints=(joint,), **EFFORT, **UPPER, **OFF)
    second = story.switches(["second"])
    steps = {2: story.switches(["upper"], ["direct"]), 3: story.switches((), ["lower"]), 4: second}
    slow(story, 6).run(14, steps | {12: second})
    assert story.answer(2)[0] == Code.COMMANDED
    assert story.answer(3) == (Code.NOT_ACTIVE_YET, {"controller": "lower"})
    assert story.active(13) == ["lower", "upper", "second"]


def test_waiting_chain_can_be_restarted_as_a_whole():
    story, both = effort_chain(4), ["lower", "upper"]
    story.run(14, {2: story.switches(["upper"], ["direct"]), 4: story.switches(both, both)})
    assert story.answer(1) == (Code.SWITCHED_AGAIN, {"controller": "lower"})
    assert isinstance(story.answer(2), Completion)
    assert story.active(13) == both
    assert story.order("activate") == ["direct", *both]


def test_a_chain_whose_modes_do_not_come_is_given_up_as_a_whole():
    story = effort_chain(3, stubborn=(1,))
    story.run(12, {2: story.switches(["upper"], ["direct"])})
    assert story.answer()[0] == Code.MODE_NOT_ENTERED
    assert story.active(11) == []
    assert story.order("activate") == ["direct"]


@pytest.mark.parametrize("enters", ["lower", "upper"])
def test_one_that_fails_while_it_waits_for_modes_is_not_activated(enters):
    """Alone, and with one above it."""
    story = effort_chain(4)
    story.run(12, {2: story.switches([enters], ["direct"]), 4: parameters_break(story, "lower")})
    assert [story.answer(number)[0] for number in (1, 2)] == [Code.CONTROLLER_FAULT] * 2
    assert story.order("activate") == ["direct"]
    assert story.result.reason == "fault"


def test_a_fallback_comes_after_all_that_enter_in_this_cycle_also_by_other_switches(story):
    story.controller("left", joints=("j0",), fallback="greedy", **EFFORT, **OFF)
    story.controller("right", joints=("j1",), **EFFORT, **OFF).controller("greedy", **EFFORT, **OFF)
    story.breaks("left", "activate")()
    slow(story, 3).run(12, {2: [story.switches(["left"]), story.switches(["right"])]})
    assert story.answer()[0] == Code.CONTROLLER_FAULT
    assert "greedy" not in story.order("activate")
    assert story.result.reason == "fault"


def test_a_fallback_of_another_mode_waits_while_what_is_above_has_left(story):
    story.controller("lower", reference=("effort",), fallback="still", **EFFORT)
    story.controller("upper", **EFFORT, **UPPER).controller("still", **OFF)
    slow(story, 2).run(14, {5: story.breaks("lower")})
    assert [story.active(cycle) for cycle in (4, 5)] == [["lower", "upper"], []]
    story.ends("still", after=13)


def test_a_chain_that_waits_is_given_up_when_an_active_lower_end_fails():
    story = Story(joints=3).controller("ready", joints=("j0",), fallback="spare", **LOWER)
    story.controller("slow", joints=("j1",), command=("position", "effort"), **LOWER, **OFF)
    story.controller("upper", joints=("j0", "j1"), into=("ready", "slow"), **OFF)
    story.controller("spare", joints=("j0",), **OFF)
    slow(story, 5).run(14, {2: story.switches(["upper"]), 4: story.breaks("ready")})
    code, fields = story.answer()
    assert (code, fields["controller"]) == (Code.CONTROLLER_FAULT, "upper")
    assert story.active(13) == ["spare"]


# Loading


def loaded(story, at=(), **options):
    """Load a controller of upper's type in a pause; return the answer."""
    load = story.loads("extra", type="upper", active=False, **options)
    story.chain().run(12, {2: story.asks("pause"), 3: load, 5: story.asks("resume")} | dict(at))
    return story.answer(2)


def test_a_controller_that_is_loaded_may_command_references(story):
    answer = loaded(story, {7: story.switches(["extra"], ["upper"])}, **UPPER)
    assert isinstance(answer, Completion)
    assert story.active(8) == ["lower", "extra"]
    assert story.column("position", 0)[8] == 0.4


@pytest.mark.parametrize(
    ("options", "code", "fields"),
    [
        (LOWER, Code.NO_NEW_REFERENCES, {"controller": "extra"}),
        ({"into": ("nothing",)}, Code.UNKNOWN_CONTROLLER, {"controller": ("nothing",)}),
        (
            UPPER | EFFORT,
            Code.CONTROLLER_FAULT,
            {"problem": "controller extra commands j0/effort, but none of lower exports it"},
        ),
        (UPPER | {"reads": ("lower/j0/position", "upper/j0/position")}, Code.CONTROLLER_FAULT, {}),
    ],
)
def test_a_controller_that_does_not_fit_the_graph_is_not_loaded(story, options, code, fields):
    found, given = loaded(story, **options)
    assert found is code
    assert given.items() >= fields.items()


def test_the_lower_end_of_one_that_is_loaded_is_not_unloaded(story):
    unload = [story.asks("unload", controller=name) for name in ("lower", "upper", "lower")]
    load = story.loads("lower", active=False, **LOWER)
    story.chain(active=False).run(9, {2: story.asks("pause"), 3: unload, 6: [load, story.asks("resume")]})
    assert story.answer(2) == commanded("lower", "upper", "unload upper first")
    assert all(isinstance(story.answer(number), Completion) for number in (3, 4, 5))


def test_a_rate_at_which_a_lower_end_is_slower_than_the_upper_one_is_refused(story):
    story.controller("lower", rate=50.0, **LOWER).controller("upper", **UPPER)
    story.run(6, {2: story.asks("rate", rate=100.0), 3: story.asks("rate", rate=50.0)})
    code, fields = story.answer()
    assert (code, fields["controller"], fields["upper"]) == (Code.RATE_BELOW_UPPER, "lower", "upper")
    assert isinstance(story.answer(2), Completion)
