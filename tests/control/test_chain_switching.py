"""Chains in switches and faults: what enters and leaves together, what is refused, which fallback comes."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec import to_builtins

from dxlrun.channels.answers import Code, Done, Waiting
from dxlrun.channels.cycle import Clamp
from dxlrun.channels.events import EventCode
from dxlrun.description.modes import Mode
from dxlrun.errors import ControllerFault
from dxlrun.plan.loop_plan import ControllerPlan

PERIOD_NS = 20_000_000
NAN = np.nan


class Story:
    """A robot whose controllers hold references and raise when the story wants it."""

    def __init__(self, robot):
        self.robot = robot
        self.raises = {}
        self.commands = {}
        self.called = []

    def add(self, name, **options):
        options.setdefault("command", ("position",))

        def act(controller, step, time_ns, _):
            self.called.append((name, step))
            if (name, step) in self.raises:
                raise self.raises.pop((name, step))
            if step == "update" and options["command"]:
                context = controller.context
                value = self.commands.get(name)
                for interface in options["command"]:
                    mine = getattr(context.commands, interface)
                    given = getattr(context.references, interface)
                    if value is not None:
                        mine[:] = value
                    elif np.isfinite(given).any():
                        np.copyto(mine, given)

        self.robot.script(name, act, **options)
        return self

    def run(self, cycles, **at):
        """Run so many cycles; `at` maps c3 to what is called before the read of cycle 3."""
        self.robot.build(end_ns=cycles * PERIOD_NS)
        wishes = {int(key[1:]): value for key, value in at.items()}

        def idle(deadline_ns):
            cycle = len(self.robot.sink.cycles)
            if cycle in wishes:
                wishes[cycle]()

        self.robot.hardware.idle = idle
        self.result = self.robot.loop.run()
        return self.result

    def switch(self, activate=(), deactivate=()):
        return lambda: self.robot.ask("switch", activate=list(activate), deactivate=list(deactivate))

    def breaks(self, name, step="update"):
        def plan():
            self.raises[name, step] = RuntimeError("broken")

        return plan

    def active(self, cycle):
        mask = self.robot.sink.cycles[cycle]["active"]
        return [plan.name for bit, plan in enumerate(self.robot.plan.controllers) if mask >> bit & 1]

    def answer(self, number=1):
        return self.robot.answer(number)

    def events(self, code):
        return self.robot.events.of(code)


@pytest.fixture
def story(robot):
    return Story(robot)


def chain(story, *, active=True, **upper):
    """Add `lower` and `upper`, which is into it, and `other`, which claims the same servos."""
    story.add("lower", active=active, reference=("position",))
    story.add("upper", active=active, into=("lower",), **upper)
    story.commands["upper"] = 0.4
    return story


# Switches


def test_the_lower_end_enters_with_the_upper_one_first(story):
    chain(story, active=False).run(6, c2=story.switch(["upper"]))
    assert [story.active(cycle) for cycle in (1, 2)] == [[], ["lower", "upper"]]
    assert story.called[:2] == [("lower", "activate"), ("upper", "activate")]
    assert story.answer() == Done(2)
    assert story.robot.sink.cycles[2]["position"][0] == 0.4


def test_a_lower_end_that_is_active_stays_as_it_is(story):
    story.add("lower", reference=("position",))
    story.add("upper", into=("lower",), active=False)
    story.run(6, c2=story.switch(["upper"]))
    assert story.called.count(("lower", "activate")) == 1
    assert story.active(2) == ["lower", "upper"]


def test_three_in_a_chain_enter_from_the_bottom(story):
    story.add("top", into=("middle",), active=False)
    story.add("middle", into=("bottom",), reference=("position",), active=False)
    story.add("bottom", reference=("position",), active=False)
    story.run(4, c1=story.switch(["top"]))
    assert [name for name, step in story.called if step == "activate"] == ["bottom", "middle", "top"]


def test_the_run_begins_from_the_bottom_and_ends_from_the_top(story):
    story.add("top", into=("middle",))
    story.add("beside", joints=("j1",), command=())
    story.add("middle", into=("bottom",), reference=("position",))
    story.add("bottom", reference=("position",))
    story.run(2)
    assert [name for name, step in story.called if step == "activate"] == [
        "bottom",
        "middle",
        "top",
        "beside",
    ]
    left = [name for name, step in story.called if step == "deactivate"]
    assert left.index("top") < left.index("middle") < left.index("bottom")


def test_the_lower_end_of_an_active_one_is_not_deactivated(story):
    chain(story).run(6, c2=story.switch((), ["lower"]))
    assert story.answer() == (
        Code.COMMANDED,
        {"controller": "lower", "upper": "upper", "hint": "deactivate upper in the same switch"},
    )
    assert story.active(5) == ["lower", "upper"]


def test_nor_is_it_restarted_alone(story):
    chain(story).run(6, c2=story.switch(["lower"], ["lower"]))
    assert story.answer()[0] == Code.COMMANDED


def test_nor_taken_from_one_that_enters(story):
    story.add("lower", reference=("position",))
    story.add("upper", into=("lower",), active=False)
    story.run(6, c2=story.switch(["upper"], ["lower"]))
    assert story.answer()[0] == Code.COMMANDED
    assert story.active(5) == ["lower"]


def test_both_ends_leave_together_the_upper_one_first(story):
    chain(story).run(6, c2=story.switch((), ["lower", "upper"]))
    assert story.active(2) == []
    assert [name for name, step in story.called if step == "deactivate"] == ["upper", "lower"]


def test_a_chain_begins_anew_together(story):
    chain(story).run(6, c2=story.switch(["upper"], ["lower", "upper"]))
    assert story.answer() == Done(2)
    assert story.active(2) == ["lower", "upper"]
    assert story.called.count(("lower", "activate")) == 2


def test_the_upper_end_leaves_alone_and_the_lower_one_has_no_references(story):
    chain(story).run(6, c3=story.switch((), ["upper"]))
    assert story.active(3) == ["lower"]
    np.testing.assert_array_equal(story.robot.sink.cycles[2]["reference"], [0.4, 0.4])
    assert np.isnan(story.robot.sink.cycles[3]["reference"]).all()


def test_another_one_takes_over_the_references_in_one_cycle(story):
    chain(story).add("next", into=("lower",), active=False)
    story.commands["next"] = -0.2
    story.run(8, c4=story.switch(["next"], ["upper"]))
    values = [cycle["reference"][0] for cycle in story.robot.sink.cycles]
    assert values == [0.4] * 4 + [-0.2] * 4


def test_two_commanders_of_one_reference_are_refused(story):
    chain(story).add("next", into=("lower",), joints=("j1",), active=False)
    story.run(6, c2=story.switch(["next"]))
    assert story.answer() == (
        Code.JOINTS_CLAIMED,
        {
            "conflict": "controllers upper and next both command lower/j1/position",
            "joints": ("j1",),
            "holders": ("upper",),
            "others": ("next",),
        },
    )


def test_a_chain_is_refused_where_its_lower_end_would_claim_a_taken_servo(story):
    chain(story, active=False).add("direct", joints=("j1",))
    story.run(6, c2=story.switch(["upper"]))
    code, fields = story.answer()
    assert (code, fields["conflict"]) == (
        Code.JOINTS_CLAIMED,
        "controllers direct and lower both command joint j1",
    )
    assert story.active(5) == ["direct"]


def test_a_chain_takes_the_place_of_one_that_commands_the_servos(story):
    chain(story, active=False).add("direct", joints=("j0",))
    story.commands["direct"] = 0.1
    story.run(6, c3=story.switch(["upper"], ["direct"]))
    assert [story.active(cycle) for cycle in (2, 3)] == [["direct"], ["lower", "upper"]]
    assert [cycle["position"][0] for cycle in story.robot.sink.cycles] == [0.1] * 3 + [0.4] * 3


def test_a_command_for_one_that_is_commanded_is_refused(story):
    chain(story).run(6, c2=lambda: story.robot.post("lower", "position", b""))
    assert story.answer() == (
        Code.COMMANDED,
        {"controller": "lower", "upper": "upper", "hint": "command upper, or deactivate it"},
    )
    assert ("lower", "command") not in story.called


def test_a_planned_command_for_one_that_is_commanded_is_refused_and_reported(story):
    chain(story)
    story.robot.send(PERIOD_NS, "lower", "position", 0.1, 0.1)
    story.run(6)
    assert "lower is commanded by upper" in story.events(EventCode.COMMAND_REFUSED)[0][1]


def test_a_command_for_the_lower_end_alone_is_taken(story):
    chain(story).run(6, c2=story.switch((), ["upper"]), c3=lambda: story.robot.post("lower", "p", b""))
    assert story.answer(2) == Done(3)


def test_a_stream_of_the_lower_end_ends_when_the_upper_one_enters(story):
    story.add("lower", reference=("position",))
    story.add("upper", into=("lower",), active=False)
    story.commands["upper"] = 0.4
    story.run(
        9,
        c1=lambda: story.robot.post("lower", "p", b"", 3 * PERIOD_NS),
        c2=story.switch(["upper"]),
    )
    assert not story.events(EventCode.STALE_COMMAND)
    assert story.robot.sink.cycles[8]["position"][0] == 0.4


def test_a_lower_end_that_was_held_goes_on_when_the_upper_one_enters(story):
    story.add("lower", reference=("position",))
    story.add("upper", into=("lower",), active=False)
    story.commands["upper"] = 0.4
    story.run(
        12,
        c1=lambda: story.robot.post("lower", "p", b"", PERIOD_NS),
        c6=story.switch(["upper"]),
    )
    assert len(story.events(EventCode.STALE_COMMAND)) == 1
    assert story.robot.sink.cycles[6]["position"][0] == 0.4


def test_a_stale_stream_of_the_upper_end_takes_its_references_back(story):
    chain(story).run(8, c2=lambda: story.robot.post("upper", "p", b"", PERIOD_NS))
    assert len(story.events(EventCode.STALE_COMMAND)) == 1
    assert np.isnan(story.robot.sink.cycles[7]["reference"]).all()
    assert story.active(7) == ["lower", "upper"]
    assert story.called[-3:-2] == [("lower", "update")]  # it goes on and holds


# Lost servos


def test_the_upper_end_waits_for_a_joint_of_the_lower_one_that_is_lost(make_robot):
    robot = make_robot(joints=3)
    story = Story(robot)
    story.add("lower", reference=("position",))
    story.add("upper", into=("lower",), joints=("j0",))
    story.add("beside", joints=("j1",), command=())
    story.commands["upper"] = 0.4
    robot.build(end_ns=20 * PERIOD_NS)
    states = robot.record.states
    read = robot.hardware.read

    def hardware_read():
        read()
        lost = 4 <= len(robot.sink.cycles) < 12
        states.valid[2] = not lost
        states.age_ns[2] = 10**9 if lost else 0

    robot.hardware.read = hardware_read
    robot.loop.run()
    held = [bool(np.isnan(cycle["reference"][0])) for cycle in robot.sink.cycles]
    assert held == [False] * 6 + [True] * 6 + [False] * 8
    shown = [name for name, text in robot.events.of(EventCode.POLICY) if "is held" in text]
    assert sorted(shown) == ["lower", "upper"]


# Faults


def test_a_fault_of_the_upper_end_without_a_fallback_ends_the_run(story):
    chain(story).run(8, c3=story.breaks("upper"))
    assert (story.result.reason, story.result.detail) == (
        "fault",
        "controller upper raised in update: RuntimeError: broken",
    )
    assert story.active(3) == ["lower"]
    assert np.isnan(story.robot.sink.cycles[3]["reference"]).all()


def test_a_nan_in_a_reference_is_the_fault_of_the_upper_end_and_never_reaches_the_lower_one(story):
    chain(story, fallback="hold").add("hold", into=("lower",), active=False)
    story.commands["hold"] = 0.2

    def nan():
        story.commands["upper"] = [0.4, NAN]

    story.run(8, c3=nan)
    assert story.events(EventCode.CONTROLLER_FAULT) == [
        ("upper", "controller upper commanded lower/j1/position = nan after a finite value")
    ]
    assert story.result.reason == "ended"
    assert story.active(4) == ["lower", "hold"]
    assert not (story.robot.sink.cycles[3]["clamped"] & Clamp.NOT_FINITE).any()
    values = [cycle["reference"][1] for cycle in story.robot.sink.cycles]
    assert values[:3] == [0.4] * 3
    assert values[4:] == [0.2] * 4


def test_an_infinite_reference_is_a_fault_at_once(story):
    chain(story)
    story.commands["upper"] = np.inf
    story.run(3)
    assert "commanded lower/j0/position = inf" in story.result.detail


def test_a_fault_of_the_lower_end_takes_all_above_out_and_its_fallback_takes_over(story):
    story.add("top", into=("lower",))
    story.add("lower", reference=("position",), fallback="still")
    story.add("still", active=False)
    story.commands |= {"top": 0.4, "still": 0.1}
    story.run(8, c3=story.breaks("lower"))
    assert (story.result.reason, story.active(3)) == ("ended", ["still"])
    assert ("top", "deactivate") in story.called
    assert story.robot.sink.cycles[3]["position"][0] == 0.1
    assert np.isnan(story.robot.sink.cycles[3]["reference"]).all()


def test_without_a_fallback_of_its_own_the_nearest_one_above_takes_over(story):
    story.add("top", into=("middle",), fallback="far")
    story.add("middle", into=("lower",), reference=("position",), fallback="near")
    story.add("lower", reference=("position",))
    story.add("far", active=False)
    story.add("near", active=False)
    story.run(8, c3=story.breaks("lower"))
    assert (story.result.reason, story.active(3)) == ("ended", ["near"])
    assert [name for name, step in story.called if step == "deactivate"][:2] == ["top", "middle"]


def test_a_fallback_that_would_need_the_failed_one_is_passed_over(story):
    story.add("middle", into=("lower",), reference=("position",), fallback="needs")
    story.add("top", into=("middle",), fallback="still")
    story.add("lower", reference=("position",))
    story.add("needs", into=("lower",), active=False)
    story.add("still", active=False)
    story.run(8, c3=story.breaks("lower"))
    assert (story.result.reason, story.active(3)) == ("ended", ["still"])


def test_the_lower_end_leaves_where_the_fallback_claims_its_servos(story):
    chain(story, fallback="still").add("still", active=False, joints=("j1",))
    story.run(8, c3=story.breaks("upper"))
    assert (story.result.reason, story.active(3)) == ("ended", ["still"])
    assert ("lower", "deactivate") in story.called


def test_the_lower_end_stays_where_the_fallback_goes_into_it(story):
    chain(story, fallback="still").add("still", active=False, into=("lower",))
    story.commands["still"] = 0.2
    story.run(8, c3=story.breaks("upper"))
    assert (story.result.reason, story.active(4)) == ("ended", ["lower", "still"])
    assert story.called.count(("lower", "activate")) == 1
    assert story.robot.sink.cycles[4]["position"][0] == 0.2


def test_the_lower_end_stays_where_the_fallback_claims_none_of_its_servos(make_robot):
    story = Story(make_robot(joints=3))
    story.add("lower", joints=("j0", "j1"), reference=("position",))
    story.add("upper", joints=("j0", "j1"), into=("lower",), fallback="beside")
    story.add("beside", joints=("j2",), active=False)
    story.run(8, c3=story.breaks("upper"))
    assert (story.result.reason, story.active(3)) == ("ended", ["lower", "beside"])


def test_a_fallback_does_not_take_servos_from_a_lower_end_that_another_one_uses(story):
    story.add("lower", reference=("position",))
    story.add("left", into=("lower",), joints=("j0",), fallback="still")
    story.add("right", into=("lower",), joints=("j1",))
    story.add("still", active=False, joints=("j0",))
    story.run(8, c3=story.breaks("left"))
    assert story.result.reason == "fault"
    assert story.active(3) == ["lower", "right"]


def test_all_in_between_leave_with_the_lower_end_whose_servos_the_fallback_claims(story):
    story.add("top", into=("middle",), fallback="still")
    story.add("middle", into=("bottom",), reference=("position",))
    story.add("bottom", reference=("position",))
    story.add("still", active=False)
    story.run(8, c3=story.breaks("top"))
    assert (story.result.reason, story.active(3)) == ("ended", ["still"])
    assert [name for name, step in story.called if step == "deactivate"][:2] == ["middle", "bottom"]


def test_a_middle_one_that_fails_is_replaced_at_the_bottom(story):
    story.add("top", into=("middle",))
    story.add("middle", into=("bottom",), reference=("position",), fallback="hold")
    story.add("bottom", reference=("position",))
    story.add("hold", into=("bottom",), active=False)
    story.run(8, c3=story.breaks("middle"))
    assert (story.result.reason, story.active(3)) == ("ended", ["bottom", "hold"])


def test_a_lower_end_that_fails_to_activate_keeps_the_upper_one_out(story):
    chain(story, active=False, fallback="still").add("still", active=False)
    story.raises["lower", "activate"] = RuntimeError("no")
    story.run(6, c2=story.switch(["upper"]))
    assert ("upper", "activate") not in story.called
    assert (story.result.reason, story.active(3)) == ("ended", ["still"])
    code, fields = story.answer()
    assert (code, fields["controller"]) == (Code.CONTROLLER_FAULT, "lower")
    assert "upper is not activated: lower" in story.events(EventCode.COMMAND_REFUSED)[0][1]


def test_an_upper_end_that_fails_to_activate_leaves_the_lower_one_holding(story):
    chain(story, active=False, fallback="calm").add("calm", active=False, into=("lower",))
    story.raises["upper", "activate"] = RuntimeError("no")
    story.run(6, c2=story.switch(["upper"]))
    assert (story.result.reason, story.active(3)) == ("ended", ["lower", "calm"])


def test_a_fault_in_a_command_takes_the_same_way(story):
    chain(story, fallback="still").add("still", active=False)
    story.raises["upper", "command"] = RuntimeError("no")
    story.run(8, c3=lambda: story.robot.post("upper", "p", b""))
    assert (story.result.reason, story.active(3)) == ("ended", ["still"])


def test_a_fallback_of_a_lower_end_that_fails_as_it_is_taken_over_comes_after_all_have_entered(make_robot):
    """Its fallback claims a servo of another one that enters in the same switch: that one has it."""
    story = Story(make_robot(joints=3))
    story.add("lower", joints=("j0", "j1"), reference=("position",), fallback="greedy")
    story.add("upper", joints=("j0", "j1"), into=("lower",), active=False)
    story.add("beside", joints=("j2",), active=False)
    story.add("greedy", active=False)

    def fails_to_follow():
        def follow(time_ns):
            raise ControllerFault("controller lower raised in on_cancel")

        story.robot.manager._named["lower"].follow = follow
        story.switch(["upper", "beside"])()

    story.run(8, c3=fails_to_follow)
    assert story.active(3) == ["beside"]
    assert story.result.reason == "fault"


def test_a_fallback_comes_after_all_that_enter_in_this_cycle_also_by_other_switches(story):
    story.add("left", command=("effort",), joints=("j0",), active=False, fallback="greedy")
    story.add("right", command=("effort",), joints=("j1",), active=False)
    story.add("greedy", command=("effort",), active=False)
    story.raises["left", "activate"] = RuntimeError("no")

    def both():
        story.switch(["left"])()
        story.switch(["right"])()

    run_with_modes(story, 12, Modes(story.robot, 3), c2=both)
    assert story.answer(1)[0] == Code.CONTROLLER_FAULT
    assert ("greedy", "activate") not in story.called
    assert story.result.reason == "fault"


def parameters_break(story, name):
    """Return a request of live parameters that a controller raises at."""

    def request():
        def on_parameters(time_ns):
            raise RuntimeError("broken")

        story.robot.manager._named[name]._controller.on_parameters = on_parameters
        story.robot.ask("parameters", controller=name, values={})

    return request


@pytest.mark.parametrize("enters", ["lower", "upper"])
def test_one_that_fails_while_it_waits_for_modes_is_not_activated(story, enters):
    """Alone, and with one above it."""
    effort_chain(story)
    switch, breaks = story.switch([enters], ["direct"]), parameters_break(story, "lower")
    run_with_modes(story, 12, Modes(story.robot, 4), c2=switch, c4=breaks)
    assert story.answer(1)[0] == Code.CONTROLLER_FAULT
    assert story.answer(2)[0] == Code.CONTROLLER_FAULT
    assert not {("lower", "activate"), ("upper", "activate")} & set(story.called)
    assert story.result.reason == "fault"


def test_an_inactive_one_that_fails_takes_no_command_from_the_one_that_has_its_joints(story):
    story.add("slow", every=4)
    story.add("spare", active=False)
    story.commands["slow"] = 0.3
    story.run(8, c6=parameters_break(story, "spare"))
    assert story.answer(1)[0] == Code.CONTROLLER_FAULT
    assert [cycle["position"][0] for cycle in story.robot.sink.cycles] == [0.3] * 8


def test_two_fallbacks_that_fail_in_turn_end_the_run(story):
    chain(story, fallback="still").add("still", active=False, fallback="upper")
    story.run(9, c3=story.breaks("upper"), c5=story.breaks("still"))
    assert story.result.reason == "fault"


def test_the_gate_names_the_chain_whose_command_it_cuts(story):
    chain(story)
    story.commands["upper"] = 3.0
    story.run(60)
    assert (
        "j0",
        "j0, controller lower, commanded by upper: lowered to the upper position limit",
    ) in story.events(EventCode.GATE)


# Modes


class Modes:
    """Servos that need some cycles for a mode, or never come into it."""

    def __init__(self, robot, cycles, never=()):
        self.robot, self.cycles, self.never = robot, cycles, never
        self.wanted = None
        self.at = 0

    def attach(self):
        states, sink = self.robot.record.states, self.robot.sink
        read = self.robot.hardware.read

        def set_modes(modes):
            self.wanted, self.at = modes.copy(), len(sink.cycles)
            states.mode[modes != 0] = Mode.UNKNOWN

        def hardware_read():
            if self.wanted is not None and len(sink.cycles) >= self.at + self.cycles:
                for row in np.flatnonzero(self.wanted):
                    states.mode[row] = Mode.POSITION if row in self.never else self.wanted[row]
                self.wanted = None
            read()

        self.robot.hardware.read = hardware_read
        self.robot.manager._modes._set_modes = set_modes


def run_with_modes(story, cycles, modes, **at):
    build = story.robot.build

    def built(**options):
        build(**options)
        modes.attach()

    story.robot.build = built
    return story.run(cycles, **at)


def effort_chain(story):
    story.add("direct")
    story.add("lower", active=False, command=("effort",), reference=("effort",))
    story.add("upper", active=False, command=("effort",), into=("lower",), joints=("j0",))
    story.commands["upper"] = 0.1
    return story


def test_a_chain_enters_together_when_the_modes_of_its_lower_end_are_there(story):
    effort_chain(story)
    run_with_modes(story, 12, Modes(story.robot, 3), c2=story.switch(["upper"], ["direct"]))
    states = [story.active(cycle) for cycle in range(8)]
    assert states[:2] == [["direct"]] * 2
    entered = states.index(["lower", "upper"])
    assert states[2:entered] == [[]] * (entered - 2)
    assert entered > 4
    assert story.answer() == Done(entered)


def test_while_a_chain_waits_neither_end_can_be_taken_from_the_other(story):
    effort_chain(story).add("second", active=False, command=("effort",), into=("lower",), joints=("j1",))
    run_with_modes(
        story,
        14,
        Modes(story.robot, 6),
        c2=story.switch(["upper"], ["direct"]),
        c3=story.switch((), ["lower"]),
        c4=story.switch(["second"]),
        c12=story.switch(["second"]),
    )
    assert story.answer(2)[0] == Code.COMMANDED
    assert story.answer(3) == (Code.NOT_ACTIVE_YET, {"controller": "lower"})
    assert story.active(13) == ["lower", "upper", "second"]


def test_a_chain_whose_modes_do_not_come_is_given_up_as_a_whole(story):
    effort_chain(story)
    run_with_modes(story, 12, Modes(story.robot, 3, never=(1,)), c2=story.switch(["upper"], ["direct"]))
    assert story.answer()[0] == Code.MODE_NOT_ENTERED
    assert story.active(11) == []
    assert not [call for call in story.called if call[1] == "activate" and call[0] != "direct"]


def test_a_fallback_of_another_mode_waits_while_what_is_above_has_left(story):
    story.add("lower", command=("effort",), reference=("effort",), fallback="still")
    story.add("upper", command=("effort",), into=("lower",))
    story.add("still", active=False)
    run_with_modes(story, 14, Modes(story.robot, 2), c5=story.breaks("lower"))
    assert story.result.reason == "ended"
    assert [story.active(cycle) for cycle in (4, 5)] == [["lower", "upper"], []]
    assert story.active(13) == ["still"]


def test_a_chain_that_waits_is_given_up_when_an_active_lower_end_fails(make_robot):
    story = Story(make_robot(joints=3))
    story.add("ready", joints=("j0",), reference=("position",), fallback="spare")
    story.add("slow", joints=("j1",), command=("position", "effort"), reference=("position",), active=False)
    story.add("upper", joints=("j0", "j1"), into=("ready", "slow"), active=False)
    story.add("spare", joints=("j0",), active=False)
    run_with_modes(story, 14, Modes(story.robot, 5), c2=story.switch(["upper"]), c4=story.breaks("ready"))
    code, fields = story.answer()
    assert (code, fields["controller"]) == (Code.CONTROLLER_FAULT, "upper")
    assert story.active(13) == ["spare"]


def test_a_waiting_chain_answers_with_all_that_enter(story):
    effort_chain(story)
    answers = []
    keep = story.robot.inbox.answer

    def answer(number, what):
        answers.append(what)
        keep(number, what)

    story.robot.inbox.answer = answer
    run_with_modes(story, 12, Modes(story.robot, 3), c2=story.switch(["upper"], ["direct"]))
    assert answers[0] == Waiting(("lower", "upper"))


# Loading


def loaded(story, plan, cycles=12, **more):
    def load():
        story.robot.ask("load", **to_builtins(plan))

    return story.run(
        cycles,
        c2=lambda: story.robot.ask("pause"),
        c3=load,
        c5=lambda: story.robot.ask("resume"),
        **more,
    )


def extra(name="extra", kind="upper", **options):
    return ControllerPlan(
        **{
            "name": name,
            "type": kind,
            "distribution": "tests 1",
            "parameters": "{}",
            "joints": ("j0", "j1"),
            "command": ("position",),
            "publishes": (),
            "active": False,
            "every": 1,
        }
        | options
    )


def test_a_controller_that_is_loaded_may_command_references(story):
    chain(story)
    loaded(
        story,
        extra(into=("lower",)),
        c7=story.switch(["extra"], ["upper"]),
    )
    assert isinstance(story.answer(2), Done)
    assert story.robot.sink.cycles[8]["position"][0] == 0.4
    assert story.robot.manager._named["extra"].plan.into == ("lower",)


def test_a_controller_that_is_loaded_exports_no_new_references(story):
    chain(story)
    loaded(story, extra(reference=("position",)))
    assert story.answer(2) == (Code.NO_NEW_REFERENCES, {"controller": "extra"})


def test_a_controller_that_is_loaded_goes_into_one_that_is_there(story):
    chain(story)
    loaded(story, extra(into=("nothing",)))
    assert story.answer(2) == (Code.UNKNOWN_CONTROLLER, {"controller": ("nothing",)})


def test_a_controller_that_is_loaded_commands_what_is_exported(story):
    chain(story)
    loaded(story, extra(into=("lower",), command=("effort",)))
    code, fields = story.answer(2)
    assert code == Code.CONTROLLER_FAULT
    assert fields["problem"] == "controller extra commands j0/effort, which none of lower exports"


def test_a_controller_that_is_loaded_closes_no_circle(story):
    chain(story)
    loaded(story, extra(into=("lower",), reads=("lower/j0/position", "upper/j0/position")))
    assert story.answer(2)[0] == Code.CONTROLLER_FAULT  # upper exports nothing


def test_the_lower_end_of_one_that_is_loaded_is_not_unloaded(story):
    chain(story, active=False)
    story.run(
        9,
        c2=lambda: story.robot.ask("pause"),
        c3=lambda: story.robot.ask("unload", controller="lower"),
        c4=lambda: story.robot.ask("unload", controller="upper"),
        c5=lambda: story.robot.ask("unload", controller="lower"),
        c6=lambda: story.robot.ask("load", **to_builtins(extra("lower", "lower", reference=("position",)))),
        c7=lambda: story.robot.ask("resume"),
    )
    assert story.answer(2) == (
        Code.COMMANDED,
        {"controller": "lower", "upper": "upper", "hint": "unload upper first"},
    )
    assert all(isinstance(story.answer(number), Done) for number in (3, 4, 5))


def test_a_rate_at_which_a_lower_end_is_slower_than_the_upper_one_is_refused(story):
    story.add("lower", reference=("position",), rate=50.0)
    story.add("upper", into=("lower",))
    story.run(
        6, c2=lambda: story.robot.ask("rate", rate=100.0), c3=lambda: story.robot.ask("rate", rate=50.0)
    )
    code, fields = story.answer(1)
    assert (code, fields["controller"], fields["upper"]) == (Code.RATE_BELOW_UPPER, "lower", "upper")
    assert isinstance(story.answer(2), Done)
