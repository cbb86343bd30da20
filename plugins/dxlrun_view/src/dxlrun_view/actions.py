"""What the buttons of a page do with a running robot."""

from __future__ import annotations

from typing import Literal

import msgspec

from dxlrun import DxlrunError, InputError, RemoteRobot
from dxlrun.remote.requests.replies import Parameter
from dxlrun_view.live import LiveRobot, info_of
from dxlrun_view.shown import Source

Verb = Literal[
    "stop", "halt", "torque", "switch", "goal", "play", "pause", "resume", "parameters", "set_parameter"
]
LEAD_S = 0.3
"""A trajectory controller leads a joint to where its slider is in this time."""


class Action(msgspec.Struct, frozen=True):
    """One click."""

    verb: Verb
    names: tuple[str, ...] = ()
    """Joints, controllers or groups that it is about."""
    on: bool = True
    value: float | bool | str = 0.0
    """Of a slider: rad or m. Of a parameter: as in the robot file."""
    parameter: str = ""

    @property
    def always(self) -> bool:
        """True when a page may do it that may not steer."""
        return self.verb in ("stop", "parameters")


class Done(msgspec.Struct, frozen=True):
    """What became of a click."""

    said: str
    """For the page's line of messages."""
    parameters: tuple[Parameter, ...] = ()


def act(source: Source, action: Action) -> Done:
    """Do what a button asks. Raises DxlrunError with the reason when it cannot be done."""
    if not isinstance(source, LiveRobot):
        raise InputError("this is a log: nothing can be steered in it")
    if action.verb == "play" and not set(action.names) <= {*source.shown().motions}:
        raise InputError("only a motion beside the robot file is played from here")
    with source.asking() as robot:
        return _done(robot, action)


def _done(robot: RemoteRobot, action: Action) -> Done:
    name = action.names[0] if action.names else ""
    said = f"{action.verb} {', '.join(action.names)}".strip()
    match action.verb:
        case "stop":
            return Done(stopped(robot))
        case "halt":
            halted = robot.halt().halted
            said = "halted" if halted is None else f"halted in {halted.seconds:.2f} s"
        case "torque":
            robot.torque(action.names, action.on, release=not action.on)
            said = f"torque {'on' if action.on else 'off'}: {', '.join(action.names)}"
        case "switch":
            robot.switch(action.names if action.on else (), () if action.on else action.names)
            said = f"{name} is {'active' if action.on else 'not active'}"
        case "goal":
            said = _goal(robot, name, float(action.value))
        case "pause":
            robot.pause()
        case "resume":
            robot.resume()
        case "play":
            goals = robot.play(name).goals
            said = f"plays {name}" + (f" (goal {goals[0].number})" if goals else "")
        case "parameters":
            return Done("", robot.parameter_table(name))
        case "set_parameter":
            (new,) = robot.set_parameters(name, {action.parameter: action.value}).values()
            said = f"{name}: {action.parameter} is {new[1]}"
    return Done(said)


def stopped(robot: RemoteRobot) -> str:
    """Take the torque of all joints; where the run refuses that, end it: its policy takes the torque then."""
    try:
        robot.torque("all", on=False, release=True)
    except DxlrunError as error:
        robot.stop(wait=False)
        return f"the run ends: torque off was refused ({error})"
    return "STOP: torque is off, all joints are limp"


def _goal(robot: RemoteRobot, joint: str, value: float) -> str:
    """Bring a joint to a position by the active controller that commands it."""
    for row in info_of(robot).controllers:
        if row.active and joint in row.joints and "position" in row.command:
            leads = "trajectory" in row.goals
            robot.send(row.name, "position", {joint: value}, seconds=LEAD_S if leads else None)
            return f"{joint} to {value:.3f} by {row.name}"
    raise InputError(f"no active controller commands the position of {joint}; activate one")
