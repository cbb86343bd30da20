"""Actions of the page's buttons and sliders on a running robot: one class per type of JSON message.

The fields of a class are those of the message. `perform_on` sends the request to the robot and returns the
text for the page's message line; all raise DxlrunError if the robot refuses.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import msgspec

from dxlrun import DxlrunError, InputError, RemoteRobot
from dxlrun.tooling.live import Parameter
from dxlrun_view.live_robot import LiveRobot, info_of
from dxlrun_view.shown import ViewedController, ViewSource

LEAD_S = 0.3
"""Time in which a trajectory controller moves a joint to the position of its slider, s"""
PLAN_S, POLL_S = 10.0, 0.02
"""Longest time that a controller has to plan a motion, s, and time between two requests for the plan, s"""
Names = Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]


class ActionResult(msgspec.Struct, frozen=True):
    """Result of an action, as JSON for the page"""

    said: str
    """Text for the message line of the page"""
    parameters: tuple[Parameter, ...] = ()
    """Answer to ListParameters; empty for all other actions"""
    goal: Mapping[str, float] = {}
    """Answer to PlanAction: joint positions at the end, rad or m; empty without a motion"""


class _Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="verb"):
    """Base class of actions. The key `verb` of a message selects the class."""

    always: ClassVar[bool] = False
    """True if the page may perform the action without `dxlrun view --control`"""


class StopAction(_Message, frozen=True, tag="stop"):
    """STOP button: disable the torque of all joints, so that they become limp."""

    always = True

    def perform_on(self, robot: RemoteRobot) -> ActionResult:
        """Disable the torque. If the run refuses that, end the run, whose policy then disables the torque."""
        try:
            robot.torque("all", on=False, release=True)
        except DxlrunError as error:
            robot.stop(wait=False)
            return ActionResult(f"STOP: the run ends, because the robot refused torque off ({error})")
        return ActionResult("STOP: all joints are limp")


class HaltAction(_Message, frozen=True, tag="halt"):
    """Halt button: deactivate all controllers and bring the joints to rest, where they hold."""

    def perform_on(self, robot: RemoteRobot) -> ActionResult:
        """Halt the robot; return the time that the joints need to rest."""
        halted = robot.halt().halted
        return ActionResult("Halted" if halted is None else f"Halted in {halted.seconds:.2f} s")


class PauseAction(_Message, frozen=True, tag="pause"):
    """Pause button: pause the run's controllers; the joints hold."""

    def perform_on(self, robot: RemoteRobot) -> ActionResult:
        """Pause the robot."""
        robot.pause()
        return ActionResult("Paused")


class ResumeAction(_Message, frozen=True, tag="resume"):
    """Resume button: let the run's controllers continue after a pause."""

    def perform_on(self, robot: RemoteRobot) -> ActionResult:
        """Resume the robot."""
        robot.resume()
        return ActionResult("Resumed")


class TorqueAction(_Message, frozen=True, tag="torque"):
    """Enable or disable the torque of joints, groups or `all`."""

    joints: Names
    on: bool

    def perform_on(self, robot: RemoteRobot) -> ActionResult:
        """Enable the torque, or disable it and deactivate the controllers that command the joints."""
        robot.torque(self.joints, self.on, release=not self.on)
        return ActionResult(f"Torque {'on' if self.on else 'off'}: {', '.join(self.joints)}")


class SwitchAction(_Message, frozen=True, tag="switch"):
    """Activate (`on`) or deactivate a controller of the run."""

    controller: str
    on: bool

    def perform_on(self, robot: RemoteRobot) -> ActionResult:
        """Switch the controller."""
        names = (self.controller,)
        robot.switch(names if self.on else (), () if self.on else names)
        return ActionResult(f"{self.controller} is {'active' if self.on else 'not active'}")


class GoalAction(_Message, frozen=True, tag="goal"):
    """Slider of a joint: move it to a position, rad or m."""

    joint: str
    position: float

    def perform_on(self, robot: RemoteRobot) -> ActionResult:
        """Send the goal to the active controller that commands the joint's position."""
        for row in info_of(robot).controllers:
            if row.active and self.joint in row.joints and "position" in row.command:
                seconds = LEAD_S if "trajectory" in row.goals else None
                robot.send(row.name, "position", {self.joint: self.position}, seconds=seconds)
                return ActionResult(f"{self.joint} to {self.position:.3f} by {row.name}")
        raise InputError(f"no active controller commands the position of {self.joint}; activate one")


class _PoseMessage(_Message, frozen=True):
    """Pose of a handle: position in the base, m, and orientation (x, y, z, w) if it was turned."""

    controller: str
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float] | None = None

    def command(self) -> dict[str, object]:
        """Return the fields of the command."""
        return dict(zip("xyz", self.position, strict=True)) | {"quaternion": self.quaternion}


class PlanAction(_PoseMessage, frozen=True, tag="plan"):
    """Handle that is dragged: plan the motion of its tip there, without moving it."""

    def perform_on(self, robot: RemoteRobot) -> ActionResult:
        """Return the joints' positions at the end of the motion, or the reason why there is none.

        Raises:
            DxlrunError: The controller has a goal, refuses the pose, or does not answer.
        """
        name, topic = self.controller, f"/{self.controller}/plan"
        if any(goal.controller == name and goal.status == "running" for goal in robot.goals()):
            raise InputError(f"{name} moves; wait for the end of its goal")
        before = robot.newest(topic)
        robot.send(name, "plan", self.command())
        until_s = time.monotonic() + PLAN_S
        while time.monotonic() < until_s:
            found = robot.newest(topic)
            if found is not None and (before is None or found.number > before.number):
                plan = found.message
                if [plan["x"], plan["y"], plan["z"]] == [*self.position]:
                    return _planned(plan, next(row for row in info_of(robot).controllers if row.name == name))
            time.sleep(POLL_S)
        raise InputError(f"{name} has not planned within {PLAN_S:g} s; drag again")


def _planned(plan: Mapping[str, Any], row: ViewedController) -> ActionResult:
    """Return the answer to PlanAction, from the message of a plan."""
    if math.isnan(plan["duration"]):
        return ActionResult(plan["text"])
    positions = dict(zip(row.joints, map(float, plan["positions"]), strict=True))
    remark = f", {plan['text']}" if plan["text"] else ""
    return ActionResult(f"{plan['duration']:.1f} s{remark}", goal=positions)


class PoseAction(_PoseMessage, frozen=True, tag="pose"):
    """Send button of a handle: move its tip there."""

    def perform_on(self, robot: RemoteRobot) -> ActionResult:
        """Start the motion, without waiting for its end."""
        goal = robot.send(self.controller, "pose", self.command()).goal
        return ActionResult(f"{self.controller} moves" + (f" (goal {goal.number})" if goal else ""))


class PlayAction(_Message, frozen=True, tag="play"):
    """Play a motion file from the directory `motions` next to the robot file, or a motion of a controller."""

    motion: str

    def perform_on(self, robot: RemoteRobot) -> ActionResult:
        """Start the motion, without waiting for its end."""
        goals = robot.play(self.motion).goals
        return ActionResult(f"Playing {self.motion}" + (f" (goal {goals[0].number})" if goals else ""))


class ParameterListAction(_Message, frozen=True, tag="parameters"):
    """List the parameters of a controller."""

    always = True
    controller: str

    def perform_on(self, robot: RemoteRobot) -> ActionResult:
        """Return the table of the controller's parameters."""
        return ActionResult("", robot.parameter_table(self.controller))


class ParameterAction(_Message, frozen=True, tag="set_parameter"):
    """Change a parameter of a controller in the run, to a value as in the robot file."""

    controller: str
    parameter: str
    value: float | bool | str

    def perform_on(self, robot: RemoteRobot) -> ActionResult:
        """Change the parameter; return the value that it has now."""
        changed = robot.set_parameters(self.controller, {self.parameter: self.value})
        return ActionResult(
            ", ".join(f"{self.controller}: {name} is {new}" for name, (_, new) in changed.items())
        )


Action = (
    StopAction
    | HaltAction
    | PauseAction
    | ResumeAction
    | TorqueAction
    | SwitchAction
    | GoalAction
    | PlanAction
    | PoseAction
    | PlayAction
    | ParameterListAction
    | ParameterAction
)


def perform_action(source: ViewSource, action: Action) -> ActionResult:
    """Perform an action on the robot that the page shows.

    Raises:
        DxlrunError: The page shows a log, the motion file is not offered, or the robot refuses.
    """
    if not isinstance(source, LiveRobot):
        raise InputError("the page shows a log; start the robot to control it")
    if isinstance(action, PlayAction) and action.motion not in source.describe_page().motions:
        raise InputError("the page plays only motions next to the robot file; play others with `dxlrun play`")
    with source.asking() as robot:
        return action.perform_on(robot)
