"""Switches between controllers that need other modes: which enter when, which never, where joints rest."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dxlrun.channels.answers import Code, Done, Waiting
from dxlrun.channels.events import EventCode
from dxlrun.control.controllers.claims import claimed_modes, start_modes
from dxlrun.control.controllers.mode_switch import MODE_TIMEOUT_NS
from dxlrun.description.modes import Mode, mode_of
from dxlrun.plan.loop_plan import JointPlan

PERIOD_NS = 20_000_000
POSITION, VELOCITY, EFFORT = Mode.POSITION, Mode.VELOCITY, Mode.EFFORT


def holds(self: Any, step: str, time_ns: int, _: object) -> None:
    if step == "update":
        for name in ("position", "velocity", "effort"):
            getattr(self.context.commands, name)[:] = 0.1


class Story:
    """A robot whose servos take `slow` cycles to come into a mode; things happen before given cycles."""

    def __init__(self, robot: Any, slow: int = 0) -> None:
        self.robot = robot
        self.at: dict[int, Any] = {}
        self.slow = slow
        self.active: list[tuple[str, ...]] = []
        self.modes: list[list[int]] = []
        self.answers: list[tuple[int, Any]] = []
        self._pending: dict[int, np.ndarray] = {}

    def run(self, cycles: int) -> Any:
        robot, story = self.robot, self
        robot.build(end_ns=cycles * PERIOD_NS)
        hardware, states = robot.hardware, robot.record.states

        def set_modes(modes: np.ndarray) -> None:
            hardware.asked.append(modes.tolist())
            states.mode[modes != 0] = Mode.UNKNOWN
            story._pending = {len(story.modes) + story.slow: modes.copy()}

        def idle(_: int) -> None:
            cycle = len(story.modes)
            if cycle in story._pending:
                modes = story._pending.pop(cycle)
                np.copyto(states.mode, modes, where=modes != 0)
            story.modes.append(states.mode.tolist())
            story.active.append(robot.manager.active)
            story.at.get(cycle, lambda: None)()

        answer = robot.inbox.answer

        def keep(number: int, given: Any) -> None:
            self.answers.append((robot.record.cycle, given))
            answer(number, given)

        robot.inbox.answer = keep
        robot.manager._modes._set_modes = set_modes
        hardware.idle = idle
        return robot.loop.run()

    def switch(self, activate: list[str], deactivate: list[str]) -> None:
        self.robot.ask("switch", activate=activate, deactivate=deactivate)

    def text(self, code: EventCode) -> list[str]:
        return [f"{source}: {text}" for source, text in self.robot.events.of(code)]


@pytest.fixture
def story(robot: Any) -> Story:
    robot.script("arm", holds, command=("position",))
    robot.script("wheels", holds, command=("velocity",), active=False)
    robot.script("press", holds, joints=("j1",), command=("effort",), active=False)
    return Story(robot, slow=3)


def test_the_leaving_one_is_out_at_once_and_the_entering_one_waits_for_its_modes(story: Story) -> None:
    story.at[2] = lambda: story.switch(["wheels"], ["arm"])
    story.run(10)
    assert story.active[2:9] == [("arm",), (), (), (), (), (), ("wheels",)]
    assert story.answers == [(2, Waiting(("wheels",))), (7, Done(7))]
    assert story.robot.hardware.asked == [[VELOCITY, VELOCITY]]
    assert story.text(EventCode.MODE) == ["wheels: waits until its joints are in their modes"]
    last = story.robot.record
    assert last.goals.velocity.tolist() == [0.1, 0.1]
    assert np.isnan(last.goals.position).all()


def test_a_switch_between_controllers_of_one_mode_waits_for_nothing(robot: Any) -> None:
    robot.script("arm", holds, command=("position",))
    robot.script("other", holds, active=False)
    story = Story(robot)
    story.at[2] = lambda: story.switch(["other"], ["arm"])
    story.run(5)
    assert story.active[2:4] == [("arm",), ("other",)]
    assert not story.robot.hardware.asked


def test_controllers_of_one_switch_enter_in_the_same_cycle(robot: Any) -> None:
    robot.script("left", holds, joints=("j0",), command=("position",), active=False)
    robot.script("right", holds, joints=("j1",), command=("velocity",), active=False)
    story = Story(robot, slow=4)
    story.at[1] = lambda: story.switch(["left", "right"], [])
    story.run(10)
    assert {len(active) for active in story.active} == {0, 2}


def test_joints_that_never_come_into_their_modes_keep_the_controller_out(story: Story) -> None:
    story.slow = 10**6
    story.at[2] = lambda: story.switch(["press"], ["arm"])
    result = story.run(MODE_TIMEOUT_NS // PERIOD_NS + 10)
    assert result.reason == "ended"
    (text,) = story.text(EventCode.COMMAND_REFUSED)
    assert text == "press: press is not activated: j1 did not come into effort mode within 5 s"
    (_, waiting), (_, late) = story.answers
    assert waiting == Waiting(("press",))
    assert (late.code, late.fields["controller"]) == (Code.MODE_NOT_ENTERED, ("press",))
    assert story.active[-1] == ()
    assert story.robot.hardware.asked == [[0, EFFORT], [0, POSITION]]


def test_a_joint_that_refuses_its_mode_keeps_the_controller_out_at_once(story: Story) -> None:
    def refuse() -> None:
        story.robot.manager._modes._set_modes = story.robot.hardware.asked.append
        story.switch(["wheels"], ["arm"])

    story.at[2] = refuse
    story.run(6)
    (text,) = story.text(EventCode.COMMAND_REFUSED)
    told = "j0 stays in position mode instead of velocity mode, nor did 1 more"
    assert text == f"wheels: wheels is not activated: {told}"
    assert story.robot.answer(1) == (
        Code.MODE_NOT_ENTERED, {"controller": ("wheels",), "problem": told},
    )  # fmt: skip
    assert len(story.robot.hardware.asked) == 1


def test_a_waiting_controller_can_be_deactivated_and_its_joints_go_to_rest(story: Story) -> None:
    story.at[2] = lambda: story.switch(["press"], ["arm"])
    story.at[4] = lambda: story.switch(["arm"], ["press"])
    story.run(12)
    assert story.robot.answer(1) == (Code.SWITCHED_AGAIN, {"controller": "press"})
    assert story.robot.answer(2) == Done(9)
    assert story.robot.hardware.asked == [[0, EFFORT], [0, POSITION]]
    assert story.active[-1] == ("arm",)
    assert not story.text(EventCode.COMMAND_REFUSED)


def test_a_waiting_controller_has_its_joints_and_gets_no_commands_yet(story: Story) -> None:
    story.at[2] = lambda: story.switch(["wheels"], ["arm"])
    story.at[4] = lambda: (
        story.switch(["press"], []),
        story.switch(["wheels"], []),
        story.robot.post("wheels", "x"),
    )
    story.run(6)
    answers = [story.robot.answer(number) for number in (1, 2, 3, 4)]
    assert answers[0] == (Code.RUN_ENDING, {})
    code, fields = answers[1]
    assert (code, fields["joints"], fields["holders"]) == (Code.JOINTS_CLAIMED, ("j1",), ("wheels",))
    assert answers[2] == (Code.ACTIVE_ALREADY, {"controller": ("wheels",)})
    assert answers[3] == (Code.NOT_ACTIVE_YET, {"controller": "wheels"})


def test_a_controller_that_fails_when_its_modes_are_there_is_the_answer_to_its_switch(robot: Any) -> None:
    def fails(self: Any, step: str, time_ns: int, _: object) -> None:
        if step == "activate":
            raise RuntimeError("no way")

    robot.script("arm", holds, command=("position",))
    robot.script("wheels", fails, command=("velocity",), active=False)
    story = Story(robot, slow=3)
    story.at[2] = lambda: story.switch(["wheels"], ["arm"])
    story.run(10)
    code, fields = robot.answer(1)
    assert (code, fields["controller"]) == (Code.CONTROLLER_FAULT, "wheels")
    assert "no way" in fields["problem"]


def test_a_joint_without_a_claim_leaves_a_mode_in_which_it_would_not_hold(story: Story) -> None:
    story.at[1] = lambda: story.switch(["press"], ["arm"])
    story.at[8] = lambda: story.switch([], ["press"])
    story.run(16)
    assert story.robot.hardware.asked == [[0, EFFORT], [0, POSITION]]
    assert story.modes[-1] == [POSITION, POSITION]


def test_a_wheel_without_a_claim_stays_in_velocity_mode_at_rest(story: Story) -> None:
    story.at[1] = lambda: story.switch(["wheels"], ["arm"])
    story.at[8] = lambda: story.switch([], ["wheels"])
    story.run(12)
    assert story.modes[-1] == [VELOCITY, VELOCITY]
    assert story.robot.record.goals.velocity.tolist() == [0.0, 0.0]


def test_a_fallback_takes_over_when_its_modes_are_there(robot: Any) -> None:
    def breaks(self: Any, step: str, time_ns: int, _: object) -> None:
        if step == "update" and time_ns >= 3 * PERIOD_NS:
            raise RuntimeError("enough")

    robot.script("pull", breaks, command=("effort",), fallback="arm")
    robot.script("arm", holds, command=("position",), active=False)
    story = Story(robot, slow=2)
    result = story.run(14)
    assert result.reason == "ended"
    assert story.active[-1] == ("arm",)


def test_a_fallback_whose_modes_never_come_ends_the_run(robot: Any) -> None:
    def breaks(self: Any, step: str, time_ns: int, _: object) -> None:
        if step == "update" and time_ns >= 3 * PERIOD_NS:
            raise RuntimeError("enough")

    robot.script("arm", breaks, command=("position",), fallback="press")
    robot.script("press", holds, command=("effort",), active=False)
    result = Story(robot, slow=10**6).run(MODE_TIMEOUT_NS // PERIOD_NS + 10)
    assert (result.reason, "enough" in result.detail) == ("fault", True)


def test_modes_follow_from_claims_and_the_rest_of_the_joints_rests() -> None:
    joints = (JointPlan("a", -1, 1, None), JointPlan("b", -1, 1, None, continuous=True))

    class Claim:
        def __init__(
            self, name: str, joints: tuple[str, ...], command: tuple[str, ...], active: bool
        ) -> None:
            self.name, self.joints, self.command, self.active = name, joints, command, active
            self.into = ()

    claims: Any = [
        Claim("x", ("a",), ("effort",), True),
        Claim("y", ("b",), ("pwm",), False),
        Claim("z", ("a",), (), True),
    ]
    assert claimed_modes(claims) == {"a": Mode.EFFORT, "b": Mode.PWM}
    assert start_modes(joints, claims) == {"a": Mode.EFFORT, "b": Mode.VELOCITY}


@pytest.mark.parametrize("names", [(), ("effort", "velocity"), ("position", "pwm"), ("torque",)])
def test_interfaces_that_no_mode_has_together_are_refused(names: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="no servo follows"):
        mode_of(names)


def test_a_controller_that_waits_for_its_modes_is_not_unloaded(story: Story) -> None:
    ask = story.robot.ask
    story.at[2] = lambda: story.switch(["wheels"], ["arm"])
    story.at[3] = lambda: (ask("pause"), ask("unload", controller="wheels"), ask("resume"))
    story.run(10)
    answers = story.robot.refusals
    assert answers == {1: "", 2: "", 3: "wheels is active; deactivate it first", 4: ""}
    assert story.active[-1] == ("wheels",)
