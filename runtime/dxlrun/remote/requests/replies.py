"""Replies: what a running robot replies to a client, as JSON of these; gateway and client both go by them."""

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
    """Its joints are held because its stream ended."""
    rate: float
    """Hz"""
    joints: tuple[str, ...]
    command: tuple[str, ...]
    """The interfaces that it commands of them."""
    into: tuple[str, ...]
    """Controllers that it commands."""
    fallback: str
    reference: tuple[str, ...]
    """What those above it command of it."""
    reads: tuple[str, ...]
    takes: dict[str, object]
    """JSON Schema of each command."""
    goals: tuple[str, ...]
    """Those of its commands that are goals."""
    motions: dict[str, float]
    """Those that it plays by name, with their lengths, s."""


@dataclass(frozen=True)
class RunInfo:
    """A run, and the names that its robot file gives to joints and groups."""

    robot: str
    rate: float
    """Hz"""
    paused: bool
    began: float | None
    """s on the clock of the events: the first cycle, 0 s of the run's log; null: there was none yet."""
    cycles: int
    skipped: int
    joints: tuple[str, ...]
    groups: dict[str, tuple[str, ...]]


# Dataclasses, as a Struct cannot have the fields of two bases; the fields are in the order of the JSON.
@dataclass(frozen=True)
class RobotInfo(JointValues, RunInfo):
    """A run, its controllers and the commands that they take."""

    controllers: tuple[ControllerInfo, ...]
    sources: tuple[object, ...]
    """Devices and sensors, with their states and commands."""
    file: str
    """The robot file."""
    log: str | None


class Frames(msgspec.Struct, frozen=True):
    """The URDF and what moves it: a client computes where frames lie by itself."""

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
    """Events that are kept, and the newest's number."""

    events: tuple[EventRow, ...]
    last: int


class Executed(msgspec.Struct, Generic[AGoal], frozen=True, omit_defaults=True):
    """The reply to a command that the robot executed."""

    cycle: int = -1
    """The loop's cycle that did it; -1: not known."""
    goals: tuple[AGoal, ...] = ()
    """The goals that the command began, or cancelled: their numbers, in the client RemoteGoals."""
    old: int | None = None
    """What a register had before; None: it is no register, or not known."""
    value: int | None = None
    """What a register has now."""
    below: tuple[str, ...] = ()
    """Controllers that a switch activated too, because those above them were named."""
    joints: tuple[str, ...] = ()
    """Those whose torque was switched, or whose servos were rebooted."""
    deactivated: tuple[str, ...] = ()
    """Controllers that torque or a reboot took the joints from."""
    offered: tuple[str, ...] = ()
    """Those of them, of this request and earlier ones, that are inactive and whose joints have torque now."""
    seconds: float | None = None
    """Until all parts of a motion have ended."""
    halted: Halted | None = None
    """What was measured when a robot that was halted stood still."""

    @property
    def goal(self) -> AGoal | None:
        """The goal that the command is; None: it is none."""
        return self.goals[0] if self.goals else None


class Clamped(msgspec.Struct, frozen=True):
    """The reply to a set-point: how many of its values are beyond their joints' limits, and whose."""

    clamped: int
    clamped_joints: tuple[str, ...]


class Parameter(msgspec.Struct, frozen=True):
    """A parameter of a controller."""

    name: str
    value: object
    """As in the robot file; quantities with their units."""
    live: bool
    """True where it can be changed in a run."""
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
    """The reply to a change of live parameters."""

    cycle: int
    changed: tuple[NewValue, ...]


class GoalState(msgspec.Struct, frozen=True):
    """A goal as the robot reports it."""

    number: int = msgspec.field(name="goal")
    controller: str = ""
    kind: str = ""
    origin: str = ""
    """The client that sent it, or the place in a motion file."""
    status: str = "running"
    """`running`, or how it ended: `reached`, `missed`, `aborted`, `cancelled`, `preempted`."""
    progress: float = 0.0
    """0..1, as its controller reported it last."""
    error: float | None = None
    """Largest distance from the desired state, at the end the worst joint's from the goal; SI units."""
    joint: str = ""
    """The worst one at the end; empty: none was named."""
    text: str = ""
    """What the controller reported at the end."""
    accepted: float = 0.0
    """s of the run's clock"""
    ended: float | None = None
    """s of the run's clock; None while it runs."""

    @property
    def seconds(self) -> float | None:
        """From its beginning to its end; None while it runs."""
        return None if self.ended is None else self.ended - self.accepted

    @property
    def reached(self) -> bool:
        """True when it ended well."""
        return self.status == "reached"

    def describe(self) -> str:
        """Return how the goal ended: `goal 3 of left_arm reached after 1.02 s`."""
        timed = self.seconds is None or self.text.startswith("after ")  # by its controller
        after = "" if timed else f" after {self.seconds:.2f} s"
        why = f"{' ' if timed and self.seconds is not None else ': '}{self.text}" if self.text else ""
        return f"goal {self.number} of {self.controller} {self.status}{after}{why}"


class Goals(msgspec.Struct, frozen=True):
    """The goals that run, and the last that ended."""

    running: tuple[GoalState, ...]
    ended: tuple[GoalState, ...]


class TopicState(msgspec.Struct, frozen=True):
    """A topic of a running robot."""

    name: str
    """`/CONTROLLER/TOPIC`, `/goals`, `/events`, `/joint_states`."""
    type: str
    """As ROS 2 writes it: `nav_msgs/msg/Odometry`."""
    joints: tuple[str, ...]
    """Whose rows its arrays have; empty: of none."""
    count: int
    """Messages so far."""
    rate: float | None
    """Hz; None: not known yet."""


class Topics(msgspec.Struct, frozen=True):
    """What there is to listen to."""

    topics: tuple[TopicState, ...]


class Opened(msgspec.Struct, frozen=True, array_like=True, tag_field="frame", tag=0):
    """What a topic of a stream is; before its first message, and again when another controller has it."""

    place: int
    """Of the topic in the stream, by which its messages name it."""
    name: str
    type: str
    definition: str
    """The type's, as ROS 2 writes it (`ros2msg`)."""
    joints: tuple[str, ...]
    epoch_offset_ns: int
    """Wall time minus the run's clock."""


class Sample(msgspec.Struct, frozen=True, array_like=True, tag_field="frame", tag=1):
    """One message of a stream."""

    place: int
    number: int
    """Counted from 1 by the loop; numbers that do not come are missing."""
    time_ns: int
    """Of the run's clock."""
    data: bytes
    """CDR"""


class RunEnded(msgspec.Struct, frozen=True, array_like=True, tag_field="frame", tag=2):
    """The end of a stream whose run has ended in order."""


Frame = Opened | Sample | RunEnded
"""What a stream has, as MessagePack, each behind its length (uint32, little-endian); length 0: the gateway is
alive."""
FRAME_LENGTH = struct.Struct("<I")


class NotDone(msgspec.Struct, frozen=True):
    """The reply to what was refused: a sentence for a person; code and fields for a program."""

    refused: str = ""
    code: str = ""
    fields: Mapping[str, object] = {}
