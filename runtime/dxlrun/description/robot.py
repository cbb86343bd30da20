"""Robot: the form of a robot file; what its parts mean together is checked by `compile`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Discriminator,
    Field,
    Tag,
    WithJsonSchema,
    model_validator,
)

from dxlrun.description import units
from dxlrun.description.bus import Bus
from dxlrun.description.devices import Device
from dxlrun.description.form import Form, Name, refuse, with_parameters
from dxlrun.description.joints.joints import JointEntry
from dxlrun.description.joints.mechanics import (
    Transmission,
)
from dxlrun.description.sensors import SensorEntry
from dxlrun.description.units import (
    AngularVelocity,
    AutoDuration,
    Duration,
    LinearVelocity,
    Polling,
    Position,
    Rate,
    Share,
    SizeOrDuration,
)


def _cores(value: tuple[int, ...]) -> tuple[int, ...]:
    if not value or len(set(value)) < len(value):
        raise refuse("cores are given once each, and at least one", "write for example [3]")
    return value


def _one_or_more(value: object) -> object:
    if isinstance(value, str):
        return (value,)
    if not isinstance(value, list) or not value:
        raise refuse("this names no controller", "write one name, or several: [a, b]")
    return tuple(value)


class Scheduler(Form):
    """What the loop asks of the operating system."""

    policy: Literal["other", "fifo", "round_robin"] = Field(
        default="other", description="Scheduling policy.", examples=["round_robin"]
    )
    priority: int = Field(
        default=31,
        ge=1,
        le=99,
        description="Real-time priority; only for fifo and round_robin.",
        examples=["31"],
    )
    lock_memory: bool = Field(default=False, description="Keep all memory in RAM.", examples=["true"])
    cores: (
        Annotated[
            tuple[Annotated[int, Field(ge=0, le=1023)], ...], Field(strict=False), AfterValidator(_cores)
        ]
        | None
    ) = Field(default=None, description="Processor cores that the loop may run on.", examples=["[3]"])
    polling: AutoDuration = Field(
        default="auto",
        description="Longest time that the clock is polled before a deadline; auto: a tenth of the period.",
        examples=["100 us"],
    )
    reply_polling: Polling = Field(
        default=0,
        description="Longest time that a servo's reply is polled for, at most half of a core; auto: a tenth.",
        examples=["100 us"],
    )
    idle_latency: bool = Field(
        default=False, description="Keep processor cores from deep idle states.", examples=["true"]
    )


class Loop(Form):
    """The control loop."""

    rate: Rate = Field(ge=0.001, le=100_000, description="Cycles per second, Hz.", examples=["50"])
    scheduler: Scheduler = Field(
        default=Scheduler(), description="Real-time settings of the loop.", examples=["{policy: round_robin}"]
    )
    overrun: Literal["skip", "catch_up", "stop"] = Field(
        default="skip",
        description="After a late cycle, whole periods are skipped, or caught up with, or the run ends.",
        examples=["catch_up"],
    )
    tolerated_skips: Share = Field(
        default=0.1,
        description="A run that skips more of its periods than this has failed.",
        examples=["1 %"],
    )


class PoseStep(Form):
    """A step of a policy: to a pose."""

    pose: str = Field(min_length=1, description="Name of a pose.", examples=["home"])
    speed: Annotated[AngularVelocity, Field(gt=0)] = Field(
        description="How fast each joint goes there.", examples=["60 deg/s"]
    )
    linear_speed: Annotated[LinearVelocity, Field(gt=0)] | None = Field(
        default=None, description="How fast each linear joint goes there.", examples=["20 mm/s"]
    )


class TorqueStep(Form):
    """A step of a policy: less torque, little by little."""

    reduce_torque: float = Field(
        gt=0, lt=1, description="What is left of each servo's own torque limit.", examples=["0.3"]
    )
    steps: int = Field(default=5, ge=1, le=100, description="In how many steps.", examples=["5"])
    over: Annotated[Duration, Field(gt=0)] = Field(
        default=1_000_000_000, description="How long it takes.", examples=["1 s"]
    )


Word = Literal["limp", "hold"]
"""Torque off; or torque on, every joint where it is."""


def _kind_of_step(step: object) -> str:
    if isinstance(step, dict):
        return "<torque>" if "reduce_torque" in step else "<pose>"
    if isinstance(step, TorqueStep):
        return "<torque>"
    return "<pose>" if isinstance(step, PoseStep) else "<word>"


def _kind_of_policy(policy: object) -> str:
    return "<steps>" if isinstance(policy, list | tuple | dict) else "<word>"


PolicyStep = Annotated[
    Annotated[Word, Tag("<word>")]
    | Annotated[PoseStep, Tag("<pose>")]
    | Annotated[TorqueStep, Tag("<torque>")],
    Discriminator(_kind_of_step),
]
Policy = Annotated[
    Annotated[Word, Tag("<word>")]
    | Annotated[tuple[PolicyStep, ...], Field(strict=False, min_length=1), Tag("<steps>")],
    Discriminator(_kind_of_policy),
]
"""What is done, in order; after the last step the robot is limp, unless that is `hold`."""


class Group(Form):
    """Some joints by one name; what it has beside their names is in the joints when the file was read."""

    joints: Annotated[tuple[Name, ...], Field(strict=False, min_length=1)] = Field(
        description="Its joints, or other groups.", examples=["[left_shoulder, left_elbow]"]
    )


class GroupPolicies(Form):
    """What a group of joints does otherwise than the rest of the robot."""

    joints: Annotated[tuple[Name, ...], Field(strict=False)] = Field(
        default=(),
        description="Its joints, each in one at most; where it has none: the robot's group of that name.",
        examples=["[left_wheel, right_wheel]"],
    )
    on_lost_servo: Literal["hold", "limp", "stop"] | None = Field(
        default=None,
        description="hold: its controllers wait; limp: the group loses its torque; stop: the run ends.",
        examples=["limp"],
    )
    on_returned_servo: Word | None = Field(
        default=None, description="As the policy of that name, for this group.", examples=["hold"]
    )


class Policies(Form):
    """What happens at the end of a run, and on faults."""

    on_exit: Policy = Field(
        default="limp",
        description="At the end of a run.",
        examples=["[{pose: home, speed: 60 deg/s}, limp]"],
    )
    on_fault: Policy = Field(
        default="limp", description="When the loop, a bus or a controller failed.", examples=["limp"]
    )
    on_lost_servo: Policy = Field(
        default="hold",
        description="When a servo stopped answering; hold: its controllers wait, the others go on.",
        examples=["hold"],
    )
    on_returned_servo: Word = Field(
        default="limp",
        description="When a servo answers again that has rebooted; hold: it gets torque where it stands.",
        examples=["hold"],
    )
    groups: dict[Name, GroupPolicies] = Field(
        default={},
        description="Groups of joints with policies of their own for lost servos.",
        examples=["{wheels: {joints: [left_wheel, right_wheel], on_lost_servo: limp}}"],
    )
    on_stale_command: Policy = Field(
        default="hold",
        description="When a stream of commands stopped; hold: its joints stay, the run goes on.",
        examples=["hold"],
    )
    exit_timeout: Duration = Field(
        default=2_000_000_000, gt=0, description="Longest orderly end of a run.", examples=["2 s"]
    )


_ONE_OR_MORE = {"anyOf": [{"type": "string"}, {"type": "array", "minItems": 1, "items": {"type": "string"}}]}
_COMMON_KEYS = ("type", "active", "rate", "fallback", "into")


class ControllerEntry(Form):
    """One controller; the keys beside type, active, rate, fallback and into are its own parameters."""

    type: str = Field(
        min_length=1, description="Type that a plug-in offers.", examples=["joint_group_position_controller"]
    )
    active: bool = Field(default=True, description="Active from the start.", examples=["false"])
    rate: Annotated[float, Field(ge=0.001), units.rate] | None = Field(
        default=None, description="Updates per second, Hz; the loop's when absent.", examples=["50"]
    )
    fallback: str | None = Field(
        default=None,
        min_length=1,
        description="Controller that takes over when this one breaks its contract.",
        examples=["stand_still"],
    )
    into: Annotated[tuple[str, ...], BeforeValidator(_one_or_more), WithJsonSchema(_ONE_OR_MORE)] = Field(
        default=(),
        description="Controllers whose references this one commands, instead of the servos: one, or a list.",
        examples=["arm_pid"],
    )
    parameters: dict[str, object] = Field(
        default={}, description="All other keys of the entry; the controller's type says which there are."
    )

    @model_validator(mode="before")
    @classmethod
    def _gather_parameters(cls, entry: object) -> object:
        return with_parameters(entry, _COMMON_KEYS)


class Recording(Form):
    """The log."""

    directory: str = Field(
        default="logs",
        min_length=1,
        description="Where logs are written, from the working directory.",
        examples=["logs"],
    )
    split: SizeOrDuration | None = Field(
        default=None,
        description="Size or duration after which a log goes on in another file.",
        examples=["100 MB"],
    )
    keep: Duration | None = Field(
        default=None,
        description="Files whose newest record is older are deleted while the run goes on; needs split.",
        examples=["10 min"],
    )


class Gateway(Form):
    """The process by which others steer the run."""

    enabled: bool = Field(
        default=True, description="Let this user's programs steer the run.", examples=["false"]
    )


class Processes(Form):
    """Processes beside the loop."""

    refused: ClassVar[Mapping[str, str]] = {"view": "this version has no view yet; take it out"}

    gateway: Gateway = Field(
        default=Gateway(),
        description="Steering from outside, over a Unix socket.",
        examples=["{enabled: false}"],
    )


class RobotModel(Form):
    """The robot's body."""

    urdf: str = Field(
        min_length=1,
        description="Its URDF, from the folder of the file that says it; goes into the log.",
        examples=["torso.urdf"],
    )
    frames_rate: Rate = Field(
        default=30.0,
        ge=0,
        le=100_000,
        description="Messages of /tf in the log a second, Hz; 0: none.",
        examples=["10"],
    )
    imu: Name | None = Field(
        default=None,
        description="Sensor, device or controller whose orientation turns the body in the frame odom.",
        examples=["imu"],
    )
    imu_link: str | None = Field(
        default=None,
        min_length=1,
        description="Link of the URDF whose orientation that is; NAME, NAME_link or NAME_frame when absent.",
        examples=["torso"],
    )


class Simulation(Form):
    """How simulated servos move what they move; servos on a real port do not use it."""

    physics: Literal["independent", "mujoco"] = Field(
        default="independent",
        description="Each joint by itself, or all together by MuJoCo after the model's URDF.",
        examples=["mujoco"],
    )


class Robot(Form):
    """A robot file, without its arguments."""

    read_before: ClassVar[tuple[str, ...]] = ("arguments", "include", "joint_defaults")
    """Keys of the file that are taken out of it before the model sees it."""

    name: Name = Field(description="Name of the robot.", examples=["bioloid_torso"])
    buses: dict[Name, Bus] = Field(
        min_length=1, description="Serial lines by name.", examples=["{main: {port: sim, ...}}"]
    )
    loop: Loop = Field(description="The control loop.", examples=["{rate: 50}"])
    joints: dict[Name, JointEntry] = Field(
        min_length=1, description="Joints by name.", examples=["{head_joint: {bus: main, id: 1, ...}}"]
    )
    groups: dict[Name, Group] = Field(
        default={},
        description="Joints under one name, with keys that each of them gets.",
        examples=["{left_arm: {bus: main, joints: [left_shoulder, left_elbow]}}"],
    )
    devices: dict[Name, Device] = Field(
        default={},
        description="What is on a bus and is no servo, by name.",
        examples=["{imu: {bus: main, id: 241, model: ...}}"],
    )
    transmissions: dict[Name, Transmission] = Field(
        default={},
        description="Several servos that move several joints together, by name.",
        examples=["{wrist: {type: differential, joints: [roll, pitch], ...}}"],
    )
    controllers: dict[Name, ControllerEntry] = Field(
        default={},
        description="Controllers by name, updated in this order.",
        examples=["{head: {type: ...}}"],
    )
    sensors: dict[Name, SensorEntry] = Field(
        default={},
        description="Sensors by name, each with a process of its own.",
        examples=["{imu: {type: serial_imu, ...}}"],
    )
    poses: dict[Name, Annotated[dict[Name, Position], Field(min_length=1)]] = Field(
        default={},
        description="Positions of some or all joints, by name, for policies.",
        examples=["{home: {head_joint: 0 deg}}"],
    )
    policies: Policies = Field(
        default=Policies(),
        description="What happens on faults and at the end.",
        examples=["{exit_timeout: 2 s}"],
    )
    recording: Recording = Field(default=Recording(), description="The log.", examples=["{directory: logs}"])
    processes: Processes = Field(
        default=Processes(),
        description="Processes beside the loop.",
        examples=["{gateway: {enabled: false}}"],
    )
    model: RobotModel | None = Field(
        default=None, description="The robot's body.", examples=["{urdf: torso.urdf}"]
    )
    simulation: Simulation = Field(
        default=Simulation(),
        description="How simulated servos move what they move.",
        examples=["{physics: mujoco}"],
    )
