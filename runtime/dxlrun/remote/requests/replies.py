"""Replies: types of the gateway's JSON replies, shared by gateway and client."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import msgspec

from dxlrun.channels.answers import Halted
from dxlrun.plan.loop_plan import JointValues

AGoal = TypeVar("AGoal")
Written = bool | int | float | str
"""A value as written in the robot file: `4.0`, `true`, `20 deg/s`."""


class ControllerInfo(msgspec.Struct, frozen=True):
    """A controller in the loop of a running robot, as clients see it."""

    name: str
    type: str
    active: bool
    held: bool
    """True when the controller's joints are held because its stream of set-points ended."""
    rate: float
    """Rate of the controller's updates, Hz."""
    joints: tuple[str, ...]
    command: tuple[str, ...]
    """Interfaces that the controller commands at its joints: `position`, `velocity`, `effort`, `pwm`."""
    into: tuple[str, ...]
    """Names of the lower controllers that this controller commands."""
    fallback: str
    reference: tuple[str, ...]
    """References, inputs of this controller, that controllers above this one can command."""
    reads: tuple[str, ...]
    optional: tuple[str, ...]
    """Names in `reads` that the controller can do without."""
    takes: dict[str, object]
    """Command that clients can send -> JSON Schema of its fields."""
    goals: tuple[str, ...]
    """Names of the commands in `takes` that are goals: they run for a time and report a result."""
    motions: dict[str, float | None]
    """Name of each motion that the controller can play -> its duration, s; null: until it is cancelled."""


@dataclass(frozen=True)
class RunInfo:
    """A run: rate, cycles and state of its loop, and the joints and groups of its robot file."""

    robot: str
    rate: float
    """Rate of the loop, Hz."""
    paused: bool
    began: float | None
    """Start of the first cycle, s on the clock of events; it is 0 s of the log. null before that cycle."""
    cycles: int
    skipped: int
    joints: tuple[str, ...]
    groups: dict[str, tuple[str, ...]]


class JointServo(msgspec.Struct, frozen=True):
    """The first servo of a joint: its control table by model and protocol, and its temperature limit."""

    model: str
    protocol: float
    temperature_limit: float | None
    """Temperature above which the servo cuts its torque, degrees C; null: not known."""


# Dataclasses, because a Struct cannot have the fields of two bases; the fields are in the order of the JSON.
@dataclass(frozen=True)
class RobotInfo(JointValues, RunInfo):
    """A run with its joints, its devices and its controllers, and the commands that they accept."""

    controllers: tuple[ControllerInfo, ...]
    sources: tuple[object, ...]
    """Devices and sensors of the robot, with their states and commands."""
    file: str
    """Absolute path of the robot file."""
    log: str | None
    servos: dict[str, JointServo] = field(default_factory=dict)
    """First servo of each joint that servos move."""
    omitted: tuple[str, ...] = ()
    """Joints of the robot file that the run omits, then groups that have no other joint."""


class Frames(msgspec.Struct, frozen=True):
    """The robot's URDF and a plan of the joints that move it; a client computes poses of frames from them."""

    urdf: str | None
    frames: object


class EventRow(msgspec.Struct, frozen=True):
    """An event of the run, as the log has it: number, time, severity, source and text."""

    number: int
    time: float
    """s of the run's clock"""
    name: str
    severity: int
    source: str
    text: str
    origin: str = ""
    """Client that sent the command of a `steered` or `command_refused` event; empty for other events."""


class Events(msgspec.Struct, frozen=True):
    """Stored events of a run, oldest first, and the number of the newest one."""

    events: tuple[EventRow, ...]
    last: int


class Executed(msgspec.Struct, Generic[AGoal], frozen=True, omit_defaults=True):
    """Reply to a command that the robot executed; fields that do not apply have their defaults."""

    cycle: int = -1
    """Number of the loop's cycle that executed the command; -1: unknown."""
    goals: tuple[AGoal, ...] = ()
    """Goals that the command started or cancelled: numbers; in the client, RemoteGoals."""
    old: int | None = None
    """Value of the written register before; None when unknown, or for any other command."""
    value: int | None = None
    """New value of the written register, as an integer on the wire."""
    below: tuple[str, ...] = ()
    """Lower controllers that a switch activated because named ones command them."""
    joints: tuple[str, ...] = ()
    """Joints whose torque was switched, or whose servos were rebooted."""
    deactivated: tuple[str, ...] = ()
    """Controllers that this torque or reboot request deactivated."""
    offered: tuple[str, ...] = ()
    """Controllers that this or an earlier torque or reboot request deactivated, and whose joints have
    torque again."""
    seconds: float | None = None
    """Duration until all parts of a played motion have ended, s."""
    halted: Halted | None = None
    """Measurements of a halt, such as its duration, when all joints are at rest."""

    @property
    def goal(self) -> AGoal | None:
        """First goal that the command started or cancelled; None when the command is not a goal."""
        return self.goals[0] if self.goals else None


class Clamped(msgspec.Struct, frozen=True):
    """Reply to a set-point: number and joints of the values that are clamped to their joints' limits."""

    clamped: int
    clamped_joints: tuple[str, ...]


class Parameter(msgspec.Struct, frozen=True):
    """A parameter of a controller with its present value."""

    name: str
    value: object
    """Value as in the robot file; quantities are texts with units."""
    live: bool
    """True when the parameter can be changed during a run."""
    range: str = ""
    description: str = ""


class Parameters(msgspec.Struct, frozen=True):
    """All parameters of a controller."""

    parameters: tuple[Parameter, ...]


class NewValue(msgspec.Struct, frozen=True):
    """A live parameter that a request changed, with the values before and after."""

    name: str
    old: object
    new: object


class Changed(msgspec.Struct, frozen=True):
    """Reply to a change of live parameters: cycle of the change, and the parameters that differ now."""

    cycle: int
    changed: tuple[NewValue, ...]


class GoalState(msgspec.Struct, frozen=True):
    """State of a goal: progress while it runs, or its result after the end."""

    number: int = msgspec.field(name="goal")
    controller: str = ""
    kind: str = ""
    origin: str = ""
    """Client that sent the goal, or its place in a motion file."""
    status: str = "running"
    """`running`, or the result: `reached`, `missed`, `aborted`, `cancelled`, `preempted`."""
    progress: float = 0.0
    """Fraction of the goal that is done, 0 to 1, as last reported by the controller."""
    error: float | None = None
    """Largest distance of a joint from its desired state, SI units; after the end, from the goal.

    None if unknown.
    """
    joint: str = ""
    """Joint with the largest error at the end; empty when none was reported."""
    text: str = ""
    """Text of the controller's final report."""
    accepted: float = 0.0
    """Time at which the loop accepted the goal, s of the run's clock."""
    ended: float | None = None
    """Time of the end, s of the run's clock; None while the goal runs."""

    @property
    def seconds(self) -> float | None:
        """Duration from acceptance to end, s; None while the goal runs."""
        return None if self.ended is None else self.ended - self.accepted

    @property
    def reached(self) -> bool:
        """True when the goal has ended with the result `reached`."""
        return self.status == "reached"

    def describe_outcome(self) -> str:
        """Return the result as a text: `goal 3 of left_arm reached after 1.02 s`."""
        # The controller's text already has the duration.
        timed = self.seconds is None or self.text.startswith("after ")
        after = "" if timed else f" after {self.seconds:.2f} s"
        why = f"{' ' if timed and self.seconds is not None else ': '}{self.text}" if self.text else ""
        return f"goal {self.number} of {self.controller} {self.status}{after}{why}"


class Goals(msgspec.Struct, frozen=True):
    """Goals that run, and the last goals that have ended."""

    running: tuple[GoalState, ...]
    ended: tuple[GoalState, ...]


class TopicState(msgspec.Struct, frozen=True):
    """A topic of a running robot, with its message type and how many messages it had."""

    name: str
    """Name such as `/CONTROLLER/TOPIC`, `/goals`, `/events` or `/joint_states`."""
    type: str
    """Name of the message type in ROS 2 format: `nav_msgs/msg/Odometry`."""
    joints: tuple[str, ...]
    """Joints of the rows of the messages' arrays; empty: the arrays have no rows of joints."""
    count: int
    """Number of messages since the start of the run."""
    rate: float | None
    """Present rate of the messages, Hz; None when unknown."""


class Topics(msgspec.Struct, frozen=True):
    """All topics that a client can stream."""

    topics: tuple[TopicState, ...]


class StreamTopic(msgspec.Struct, frozen=True, array_like=True, tag_field="frame", tag=0):
    """Description of a topic in a stream, sent before its first message and when its publisher changes."""

    place: int
    """Number of the topic within this stream, by which its messages name it."""
    name: str
    type: str
    definition: str
    """Definition of the message type in ROS 2 format (`ros2msg`)."""
    joints: tuple[str, ...]
    epoch_offset_ns: int
    """Wall time minus the run's clock, ns."""


class StreamMessage(msgspec.Struct, frozen=True, array_like=True, tag_field="frame", tag=1):
    """One message of a topic in a stream."""

    place: int
    number: int
    """Sequence number, counted from 1 by the loop; a gap in the numbers shows lost messages."""
    time_ns: int
    """Time of the message, ns of the run's clock."""
    data: bytes
    """Content of the message, encoded as CDR (little-endian)."""


class RunEnded(msgspec.Struct, frozen=True, array_like=True, tag_field="frame", tag=2):
    """End of a stream, sent when the run has ended normally."""


Frame = StreamTopic | StreamMessage | RunEnded
"""Payload of a stream: MessagePack, each frame preceded by its length (uint32, little-endian). Length 0 is
a sign of life without content."""
FRAME_LENGTH = struct.Struct("<I")


class NotDone(msgspec.Struct, frozen=True):
    """Reply to a refused request: `refused` is a sentence for a person, code and fields are for programs."""

    refused: str = ""
    code: str = ""
    fields: Mapping[str, object] = {}
