"""Switches between controllers that need other modes: which enter when, which never, where joints rest."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tests.kit.loops import PERIOD_NS, Robot, commanding, plan_of

from dxlrun.channels.answers import Acceptance, Code, Completion
from dxlrun.channels.event_records import EventCode
from dxlrun.control.controllers.claims import claimed_modes, start_modes
from dxlrun.control.controllers.switching import MODE_TIMEOUT_NS
from dxlrun.plan.loop_plan import JointPlan
from dxlwire.modes import Mode, mode_of

POSITION, VELOCITY, EFFORT = Mode.POSITION, Mode.VELOCITY, Mode.EFFORT
TOO_LONG = MODE_TIMEOUT_NS // PERIOD_NS + 10
HOLDS = commanding(position=0.1, velocity=0.1, effort=0.1)
SPARE: dict[str, Any] = {"active": False}


class Story(Robot):
    """A robot whose joints take some cycles to come into a mode."""

    def __init__(self) -> None:
        super().__init__()
        self.answered: list[tuple[int, Any]] = []
        self.script("arm", HOLDS, command=("position",), fallback="press")
        self.script("wheels", HOLDS, command=("velocity",), **SPARE)
        self.script("press", HOLDS, joints=("j1",), command=("effort",), **SPARE)

    def through(self, cycles: int, at: Any = (), slow: int = 3) -> Any:
        """Run so many cycles; joints change their modes in `slow` of them."""
        self.build()
        self.hardware.mode_cycles = lambda: slow
        keep = self.inbox.answer_command

        def answer(number: int, given: Any) -> None:
            self.answered.append((self.record.cycle, given))
            keep(number, given)

        self.inbox.answer_command = answer  # type: ignore[method-assign]
        return self.run(cycles, dict(at))

    def refused(self) -> list[str]:
        return [f"{source}: {text}" for source, text in self.events.of(EventCode.COMMAND_REFUSED)]


@pytest.fixture
def story():
    return Story()


def test_the_leaving_one_is_out_at_once_and_the_entering_one_waits_for_its_modes(story):
    story.through(10, {2: story.switches(["wheels"], ["arm"])})
    active = [story.active(cycle) for cycle in range(10)]
    assert active == [["arm"]] * 2 + [[]] * 4 + [["wheels"]] * 4
    assert story.answered == [(2, Acceptance(("wheels",))), (6, Completion(6))]
    assert story.hardware.asked == [[VELOCITY, VELOCITY]]
    assert story.events.of(EventCode.MODE) == [("wheels", "waits for the mode changes of its joints")]
    assert story.record.goals.velocity.tolist() == [0.1, 0.1]
    assert np.isnan(story.record.goals.position).all()


def test_a_switch_between_controllers_of_one_mode_waits_for_nothing(story):
    story.script("other", HOLDS, **SPARE).run(5, {2: story.switches(["other"], ["arm"])})
    assert [story.active(cycle) for cycle in (1, 2)] == [["arm"], ["other"]]
    assert not story.hardware.asked


def test_controllers_of_one_switch_enter_in_the_same_cycle(story):
    story.script("left", HOLDS, joints=("j0",), command=("velocity",), **SPARE)
    story.through(10, {1: story.switches(["left", "press"], ["arm"])})
    assert {len(story.active(cycle)) for cycle in range(1, 10)} == {0, 2}


def test_joints_that_never_come_into_their_modes_keep_the_controller_out(story):
    story.through(TOO_LONG, {2: story.switches(["press"], ["arm"])}, slow=10**6)
    late = "press: press is not activated: j1 did not enter effort mode within 5 s"
    assert (story.result.reason, story.refused()) == ("stopped", [late])
    (_, waiting), (_, given_up) = story.answered
    assert waiting == Acceptance(("press",))
    assert (given_up.code, given_up.fields["controller"]) == (Code.MODE_NOT_ENTERED, ("press",))
    assert story.active(-1) == []
    assert story.hardware.asked == [[0, EFFORT], [0, POSITION]]


def test_a_joint_that_refuses_its_mode_keeps_the_controller_out_at_once(story):
    story.build().hardware.stubborn = (0, 1)
    story.run(6, {2: story.switches(["wheels"], ["arm"])})
    told = "j0 stays in position mode instead of velocity mode (and 1 more)"
    assert story.refused() == [f"wheels: wheels is not activated: {told}"]
    assert story.answer() == (Code.MODE_NOT_ENTERED, {"controller": ("wheels",), "problem": told})
    assert len(story.hardware.asked) == 1


def test_a_waiting_controller_can_be_deactivated_and_its_joints_go_to_rest(story):
    story.through(12, {2: story.switches(["press"], ["arm"]), 4: story.switches(["arm"], ["press"])})
    assert story.answer(1) == (Code.SWITCHED_AGAIN, {"controller": "press"})
    assert story.answer(2) == Completion(8)
    assert story.hardware.asked == [[0, EFFORT], [0, POSITION]]
    assert story.active(-1) == ["arm"]
    assert not story.refused()


def test_a_switch_continues_without_a_waiting_controller_that_is_deactivated(story):
    story.script("left", HOLDS, joints=("j0",), command=("velocity",), **SPARE)
    both, one = story.switches(["left", "press"], ["arm"]), story.switches([], ["press"])
    story.through(16, {2: both, 4: one})
    assert [type(given) for _, given in story.answered] == [Acceptance, Completion, Completion]
    assert story.active(-1) == ["left"]
    assert isinstance(story.inbox.answers[1], Completion)


def test_a_waiting_controller_has_its_joints_and_gets_no_commands_yet(story):
    then = [story.switches(["press"]), story.switches(["wheels"]), story.posts("wheels", "x")]
    story.through(6, {2: story.switches(["wheels"], ["arm"]), 4: then}, slow=10)
    assert story.answer(1) == (Code.RUN_ENDING, {})
    code, fields = story.answer(2)
    assert (code, fields["joints"], fields["holders"]) == (Code.JOINTS_CLAIMED, ("j1",), ("wheels",))
    assert story.answer(3) == (Code.ACTIVE_ALREADY, {"controller": ("wheels",)})
    assert story.answer(4) == (Code.NOT_ACTIVE_YET, {"controller": "wheels"})


def test_a_waiting_controller_is_not_unloaded(story):
    then = [story.asks("pause"), story.asks("unload", controller="wheels"), story.asks("resume")]
    story.through(10, {2: story.switches(["wheels"], ["arm"]), 3: then})
    assert story.refusals == {1: "", 2: "", 3: "wheels is active; deactivate it first", 4: ""}
    assert story.active(-1) == ["wheels"]


def test_a_controller_that_fails_when_its_modes_are_there_is_the_answer_to_its_switch(story):
    story.breaks("wheels", "activate")()
    story.through(10, {2: story.switches(["wheels"], ["arm"])})
    code, fields = story.answer()
    assert (code, fields["controller"]) == (Code.CONTROLLER_FAULT, "wheels")
    assert "broken" in fields["problem"]


@pytest.mark.parametrize(
    ("name", "asked", "rests"),
    [
        ("press", [[0, EFFORT], [0, POSITION]], [POSITION, POSITION]),  # it would not hold in effort mode
        ("wheels", [[VELOCITY, VELOCITY]], [VELOCITY, VELOCITY]),  # at rest
    ],
)
def test_where_joints_rest_that_are_not_claimed_any_more(story, name, asked, rests):
    story.through(16, {1: story.switches([name], ["arm"]), 8: story.switches([], [name])})
    assert story.hardware.asked == asked
    assert story.record.states.mode.tolist() == rests
    if name == "wheels":
        assert story.record.goals.velocity.tolist() == [0.0, 0.0]


@pytest.mark.parametrize(("slow", "reason"), [(2, "stopped"), (10**6, "fault")])
def test_a_fallback_takes_over_when_its_modes_are_there_and_ends_the_run_if_they_never_come(
    story, slow, reason
):
    result = story.through(TOO_LONG, {3: story.breaks("arm")}, slow)
    assert (result.reason, "broken" in result.detail) == (reason, reason == "fault")
    assert story.active(-1) == ["press"] * (reason == "stopped")


def test_modes_follow_from_claims_and_the_rest_of_the_joints_rests():
    joints = (JointPlan("a", -1, 1, None), JointPlan("b", -1, 1, None, continuous=True))
    claims = [
        plan_of("x", joints=("a",), command=("effort",)),
        plan_of("y", joints=("b",), command=("pwm",), active=False),
        plan_of("z", joints=("a",), command=()),
    ]
    assert claimed_modes(claims) == {"a": Mode.EFFORT, "b": Mode.PWM}
    assert start_modes(joints, claims) == {"a": Mode.EFFORT, "b": Mode.VELOCITY}


@pytest.mark.parametrize("names", [(), ("effort", "velocity"), ("position", "pwm"), ("torque",)])
def test_interfaces_that_no_mode_has_together_are_refused(names):
    with pytest.raises(ValueError, match=r"no servo mode (combines|is named)"):
        mode_of(names)
