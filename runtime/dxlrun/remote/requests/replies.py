"""Replies: types of the JSON replies of a running robot, shared by gateway and client."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

import msgspec

from dxlrun.channels.answers import Halted
from dxlrun.plan.loop_plan import JointValues

AGoal = TypeVar("AGoal")
Written = bool | int | float | str
"""A value as in the robot file: `4.0`, `true`, `20 deg/s`."""


class ControllerInfo(msgspec.Struct, frozen=True):
    """A controller of a running robot."""

    name: str
    type: str
    active: bool
    held: bool
    """True when the controller's joints are held because its stream ended."""
    rate: float
    """Hz"""
    joints: tuple[str, ...]
    command: tuple[str, ...]
    """Interfaces of the joints that the controller commands."""
    into: tuple[str, ...]
    """Controllers that this controller commands."""
    fallback: str
    reference: tuple[str, ...]
    """References that controllers above this one command."""
    reads: tuple[str, ...]
    takes: dict[str, object]
    """JSON Schema of each command."""
    goals: tuple[str, ...]
    """Commands that are goals."""
    motions: dict[str, float]
    """Motions that the controller plays by name, with durations, s."""


@dataclass(frozen=True)
class RunInfo:
    """A run, with the joints and groups of its robot file."""

    robot: str
    rate: float
    """Hz"""
    paused: bool
    began: float | None
    """Time of the first cycle on the clock of the events, s; 0 s of the run's log. null before the first
    cycle."""
    cycles: int
    skipped: int
    joints: tuple[str, ...]
    groups: dict[str, tuple[str, ...]]


# Dataclasses, because a Struct cannot have the fields of two bases; the fields are in the order of the JSON.
@dataclass(frozen=True)
class RobotInfo(JointValues, RunInfo):
    """A run, its controllers and the commands that they accept."""

    controllers: tuple[ControllerInfo, ...]
    sources: tuple[object, ...]
    """Devices and sensors, with their states and commands."""
    file: str
    """The robot file."""
    log: str | None


class Frames(msgspec.Struct, frozen=True):
    """URDF and the plan of its moved frames, from which a client computes the poses of frames."""

    urdf: str | None
    frames: object


class EventRow(msgspec.Struct, frozen=True):
    """An event."""

    number: int
    time: float
    """s of the run's clock"""
    name: str
    severity: int
    source: str
    text: str


class Events(msgspec.Struct, frozen=True):
    """Stored events, and the number of the newest event."""

    events: tuple[EventRow, ...]
    last: int


class Executed(msgspec.Struct, Generic[AGoal], frozen=True, omit_defaults=True):
    """Reply to a command that the robot executed."""

    cycle: int = -1
    """Cycle of the loop that executed the command; -1: unknown."""
    goals: tuple[AGoal, ...] = ()
    """Goals that the command began or cancelled: numbers; in the client, RemoteGoals."""
    old: int | None = None
    """Previous value of a register; None when unknown, or for any other command."""
    value: int | None = None
    """New value of a register."""
    below: tuple[str, ...] = ()
    """Lower controllers that a switch activated in addition to the named ones."""
    joints: tuple[str, ...] = ()
    """Joints whose torque was switched, or whose servos were rebooted."""
    deactivated: tuple[str, ...] = ()
    """Controllers that a torque or reboot request deactivated."""
    offered: tuple[str, ...] = ()
    """Controllers that this or an earlier torque or reboot request deactivated, and whose joints have
    torque again."""
    seconds: float | None = None
    """Duration until all parts of a motion have ended, s."""
    halted: Halted | None = None
    """Measurements of a halt, when all joints are at rest."""

    @property
    def goal(self) -> AGoal | None:
        """Goal that the command began; None when the command is not a goal."""
        return self.goals[0] if self.goals else None


class Clamped(msgspec.Struct, frozen=True):
    """Reply to a set-point: number and joints of the values beyond their joints' limits."""

    clamped: int
    clamped_joints: tuple[str, ...]


class Parameter(msgspec.Struct, frozen=True):
    """A parameter of a controller."""

    name: str
    value: object
    """Value as in the robot file; quantities with their units."""
    live: bool
    """True when the parameter can be changed in a run."""
    range: str = ""
    description: str = ""


class Parameters(msgspec.Struct, frozen=True):
    """All parameters of a controller."""

    parameters: tuple[Parameter, ...]


class NewValue(msgspec.Struct, frozen=True):
    """A live parameter that was changed."""

    name: str
    old: object
    new: object


class Changed(msgspec.Struct, frozen=True):
    """Reply to a change of live parameters."""

    cycle: int
    changed: tuple[NewValue, ...]


class GoalState(msgspec.Struct, frozen=True):
    """A goal as the robot reports it."""

    number: int = msgspec.field(name="goal")
    controller: str = ""
    kind: str = ""
    origin: str = ""
    """Client that sent the goal, or its place in a motion file."""
    status: str = "running"
    """`running`, or the outcome: `reached`, `missed`, `aborted`, `cancelled`, `preempted`."""
    progress: float = 0.0
    """0 to 1, as last reported by the controller."""
    error: float | None = None
    """Largest distance from the desired state; after the end, the worst joint's distance from the goal. SI
    units."""
    joint: str = ""
    """Joint with the largest error at the end; empty when none was reported."""
    text: str = ""
    """Text of the controller's final report."""
    accepted: float = 0.0
    """s of the run's clock"""
    ended: float | None = None
    """Time of the end, s of the run's clock; None while the goal runs."""

    @property
    def seconds(self) -> float | None:
        """Duration of the goal, s; None while it runs."""
        return None if self.ended is None else self.ended - self.accepted

    @property
    def reached(self) -> bool:
        """True when the goal ended with `reached`."""
        return self.status == "reached"

    def describe(self) -> str:
        """Return how the goal ended: `goal 3 of left_arm reached after 1.02 s`."""
        # The controller's text already has the duration.
        timed = self.seconds is None or self.text.startswith("after ")
        after = "" if timed else f" after {self.seconds:.2f} s"
        why = f"{' ' if timed and self.seconds is not None else ': '}{self.text}" if self.text else ""
        return f"goal {self.number} of {self.controller} {self.status}{after}{why}"


class Goals(msgspec.Struct, frozen=True):
    """Running goals, and the last ended goals."""

    running: tuple[GoalState, ...]
    ended: tuple[GoalState, ...]


class TopicState(msgspec.Struct, frozen=True):
    """A topic of a running robot."""

    name: str
    """`/CONTROLLER/TOPIC`, `/goals`, `/events`, `/joint_states`."""
    type: str
    """Name of the type in ROS 2 format: `nav_msgs/msg/Odometry`."""
    joints: tuple[str, ...]
    """Joints of the rows of its arrays; empty: the arrays have no rows of joints."""
    count: int
    """Number of messages so far."""
    rate: float | None
    """Hz; None when unknown."""


class Topics(msgspec.Struct, frozen=True):
    """Topics that a client can listen to."""

    topics: tuple[TopicState, ...]


class Opened(msgspec.Struct, frozen=True, array_like=True, tag_field="frame", tag=0):
    """Description of a topic in a stream, sent before its first message and when its publisher changes."""

    place: int
    """Number of the topic in the stream, which its messages refer to."""
    name: str
    type: str
    definition: str
    """Definition of the type in ROS 2 format (`ros2msg`)."""
    joints: tuple[str, ...]
    epoch_offset_ns: int
    """Wall time minus the run's clock."""


class Sample(msgspec.Struct, frozen=True, array_like=True, tag_field="frame", tag=1):
    """One message of a stream."""

    place: int
    number: int
    """Sequence number, counted from 1 by the loop; a gap in the numbers shows lost messages."""
    time_ns: int
    """Time of the message on the run's clock, ns."""
    data: bytes
    """CDR"""


class RunEnded(msgspec.Struct, frozen=True, array_like=True, tag_field="frame", tag=2):
    """End of a stream, sent when the run has ended normally."""


Frame = Opened | Sample | RunEnded
"""Payload of a stream: MessagePack, each frame preceded by its length (uint32, little-endian). Length 0 is
a sign of life without content."""
FRAME_LENGTH = struct.Struct("<I")


class NotDone(msgspec.Struct, frozen=True):
    """Reply to a refused request: a sentence for a person; code and fields for a program."""

    refused: str = ""
    code: str = ""
    fields: Mapping[str, object] = {}
