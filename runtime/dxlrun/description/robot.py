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

from dxlrun.description.bus import Bus
from dxlrun.description.devices import Device
from dxlrun.description.form import Form, Name, refuse
from dxlrun.description.motors.mechanics import (
    TOLERANCE_M,
    TOLERANCE_RAD,
    Direction,
    GearRatio,
    Limits,
    LinearLimits,
    MotorFile,
    OneOfServos,
    Register,
    ServoId,
    Transmission,
    TravelPerTurn,
)
from dxlrun.description.sensors import SensorEntry
from dxlrun.description.units import (
    Angle,
    AngularVelocity,
    AutoDuration,
    Duration,
    Force,
    Inertia,
    Length,
    LinearVelocity,
    Mass,
    Polling,
    Position,
    Share,
    SizeOrDuration,
    Torque,
)

LONGEST_RESPONSE_DELAY_NS, LONGEST_WRITE_TIME_NS = 1_000_000_000, 100_000_000
"""Of simulated servos; real ones are quicker by far."""


def _on_or_off(value: object) -> object:
    """Return true or false for the words on and off, which YAML 1.2 takes for texts."""
    if isinstance(value, bool):
        return value
    if value not in ("on", "off"):
        raise refuse("torque is on or off", "write `torque: off` for a joint that is to be limp")
    return value == "on"


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

    rate: float = Field(gt=0, le=100_000, description="Cycles per second, Hz.", examples=["50"])
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


class ServoSimulation(Form):
    """How slow a simulated servo is, and its motor; a servo on a real port does not use it."""

    response_delay: Annotated[Duration, Field(le=LONGEST_RESPONSE_DELAY_NS)] = Field(
        default=0,
        description="Time between an instruction to the servo and its effect on the motor.",
        examples=["20 ms"],
    )
    write_time: Annotated[Duration, Field(le=LONGEST_WRITE_TIME_NS)] = Field(
        default=0,
        description="Time after a write in which the servo receives nothing.",
        examples=["1 ms"],
    )
    motor: MotorFile | None = Field(
        default=None,
        description="Motor file of the simulated servo, where that shall be another motor than the joint's.",
        examples=["other.motor.yaml"],
    )


class JointSimulation(ServoSimulation):
    """What simulated servos move, at their joint, and how slow they are."""

    inertia: Annotated[Inertia, Field(gt=0)] | None = Field(
        default=None, description="Moment of inertia of what it moves.", examples=["0.01 kg m^2"]
    )
    friction: Annotated[Torque, Field(ge=0)] | None = Field(
        default=None, description="Friction of the joint, at every speed.", examples=["0.05 Nm"]
    )
    gravity: Annotated[Torque, Field(ge=0)] | None = Field(
        default=None, description="Torque of the weight when it sticks out horizontally.", examples=["0.3 Nm"]
    )
    gravity_angle: Angle | None = Field(
        default=None,
        description="Angle of the joint where the weight hangs straight down.",
        examples=["0 deg"],
    )


class LinearSimulation(ServoSimulation):
    """What simulated servos move of a linear joint, and how slow they are."""

    refused: ClassVar[Mapping[str, str]] = {
        "inertia": "a linear joint has a mass; write `mass: 0.2 kg`",
        "gravity_angle": "a linear joint has its weight everywhere; take gravity_angle out",
    }

    mass: Annotated[Mass, Field(gt=0)] | None = Field(
        default=None, description="Mass of what it moves.", examples=["0.2 kg"]
    )
    friction: Annotated[Force, Field(ge=0)] | None = Field(
        default=None, description="Friction of the joint, at every speed.", examples=["2 N"]
    )
    gravity: Annotated[Force, Field(ge=0)] | None = Field(
        default=None, description="Weight that pulls towards lower positions.", examples=["1.5 N"]
    )


OnOff = Annotated[
    bool,
    BeforeValidator(_on_or_off),
    WithJsonSchema({"anyOf": [{"type": "string", "enum": ["on", "off"]}, {"type": "boolean"}]}),
]


class AnyJoint(Form):
    """What every joint has, whatever moves it."""

    continuous: bool = Field(
        default=False,
        description="A wheel, or a joint of many turns; it needs no position limits.",
        examples=["true"],
    )
    torque: OnOff = Field(
        default=True,
        description="off: it is limp from the start, until `dxlrun torque on`.",
        examples=["off"],
    )


class ServoJoint(AnyJoint):
    """A joint with a servo of its own, or several: s = direction * (theta - reference) of each."""

    bus: str = Field(description="Name of its bus.", examples=["main"])
    model: str = Field(
        min_length=1, description="Model of its servo, or auto: it is asked.", examples=["AX-12A"]
    )
    reference: Angle = Field(
        description="Angle of the servo, from its zero, where the joint's is zero.", examples=["150 deg"]
    )
    direction: Direction = Field(
        description="1: the joint's angle grows as the servo's does, -1: against it.", examples=["1"]
    )
    registers: dict[Name, Register] = Field(
        default={},
        description="What its servo's control table shall hold: written at the start where it differs.",
        examples=["{position_p_gain: 800, return_delay_time: 0 us}"],
    )
    motor: MotorFile | None = Field(
        default=None,
        description="Motor file of its servo, from the folder of the file that says it.",
        examples=["elbow.motor.yaml"],
    )


class Turning(Form):
    """A joint that turns."""

    simulation: JointSimulation = Field(
        default=JointSimulation(),
        description="What its servos move when they are simulated.",
        examples=["{inertia: 0.01 kg m^2}"],
    )
    limits: Limits = Field(
        default=Limits(),
        description="Where it may go, and how fast.",
        examples=["{position: [-90 deg, 90 deg]}"],
    )


class Geared(Turning):
    """A joint that turns by one servo, or by several on its axis."""

    gear_ratio: GearRatio = Field(
        default=1.0, description="Turns of the servo for one turn of the joint.", examples=["2.5"]
    )


class Sliding(Form):
    """A linear joint: its positions are lengths."""

    travel_per_turn: TravelPerTurn = Field(
        description="How far the joint moves in one turn of the servo; makes it a linear joint.",
        examples=["94.2 mm"],
    )
    limits: LinearLimits = Field(
        default=LinearLimits(),
        description="Where it may go, and how fast.",
        examples=["{position: [0 mm, 40 mm]}"],
    )
    simulation: LinearSimulation = Field(
        default=LinearSimulation(),
        description="What its servos move when they are simulated.",
        examples=["{mass: 0.2 kg}"],
    )


class OneServo(ServoJoint):
    """A joint with one servo."""

    id: ServoId = Field(description="ID of its servo.", examples=["1"])


class SeveralServos(ServoJoint):
    """A joint with several servos, which get equal goals."""

    servos: Annotated[tuple[OneOfServos, ...], Field(strict=False, min_length=2)] = Field(
        description="Its servos; what one does not have is the joint's.",
        examples=["[{id: 1}, {id: 2, direction: -1}]"],
    )


class Joint(Geared, OneServo):
    """One joint and its servo: q = direction * (theta - reference) / gear_ratio."""


class LinearJoint(Sliding, OneServo):
    """A linear joint: q = direction * (theta - reference) * travel_per_turn / turn."""


class SharedJoint(Geared, SeveralServos):
    """One joint that several servos move."""

    tolerance: Annotated[Angle, Field(gt=0)] = Field(
        default=TOLERANCE_RAD,
        description="By how much its servos may disagree, as an angle of the joint.",
        examples=["3 deg"],
    )


class LinearSharedJoint(Sliding, SeveralServos):
    """One linear joint that several servos move."""

    tolerance: Annotated[Length, Field(gt=0)] = Field(
        default=TOLERANCE_M, description="By how much its servos may disagree.", examples=["1 mm"]
    )


class TransmittedJoint(Turning, AnyJoint):
    """One joint of a transmission, which has the servos."""


def kind_of_joint(joint: object) -> str:
    """Return which of the forms of a joint an entry has, by the keys that only one of them has."""
    if isinstance(joint, dict):
        linear, shared = "travel_per_turn" in joint, "servos" in joint
        if linear:
            return "<linear joint, several servos>" if shared else "<linear joint>"
        if shared:
            return "<several servos>"
        return "<one servo>" if _OF_A_SERVO.intersection(joint) else "<transmission>"
    kinds: tuple[tuple[type[AnyJoint], str], ...] = (
        (Joint, "<one servo>"),
        (LinearJoint, "<linear joint>"),
        (SharedJoint, "<several servos>"),
        (LinearSharedJoint, "<linear joint, several servos>"),
        (TransmittedJoint, "<transmission>"),
    )
    return next((kind for model, kind in kinds if isinstance(joint, model)), "<one servo>")


_OF_A_SERVO = frozenset(OneServo.model_fields) - frozenset(AnyJoint.model_fields)
"""Keys of a joint with a servo of its own; one without any is moved by a transmission."""

JOINT_FORMS = (
    ("LinearSharedJoint", {"required": ["travel_per_turn", "servos"]}),
    ("LinearJoint", {"required": ["travel_per_turn"]}),
    ("SharedJoint", {"required": ["servos"]}),
    ("Joint", {"anyOf": [{"required": [key]} for key in sorted(_OF_A_SERVO)]}),
)
"""The same for editors, as JSON Schemas: the first that fits counts; what fits none may be any form."""

JointEntry = Annotated[
    Annotated[Joint, Tag("<one servo>")]
    | Annotated[LinearJoint, Tag("<linear joint>")]
    | Annotated[SharedJoint, Tag("<several servos>")]
    | Annotated[LinearSharedJoint, Tag("<linear joint, several servos>")]
    | Annotated[TransmittedJoint, Tag("<transmission>")],
    Discriminator(kind_of_joint),
]


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


class GroupPolicies(Form):
    """What a group of joints does otherwise than the rest of the robot."""

    joints: Annotated[tuple[Name, ...], Field(strict=False, min_length=1)] = Field(
        description="Its joints; each is in one group at most.", examples=["[left_wheel, right_wheel]"]
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
    rate: float | None = Field(
        default=None, gt=0, description="Updates per second, Hz; the loop's when absent.", examples=["50"]
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
        if not isinstance(entry, dict):
            return entry
        own = {key: value for key, value in entry.items() if key in _COMMON_KEYS}
        return {**own, "parameters": {key: value for key, value in entry.items() if key not in own}}


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
    trigger: Literal["fault"] | None = Field(
        default=None,
        description="fault: cycles, packets and topics are kept around errors only.",
        examples=["fault"],
    )
    before: Duration | None = Field(
        default=None, description="So much before an error is kept; 10 s if it is not set.", examples=["10 s"]
    )
    after: Duration | None = Field(
        default=None, description="So much after an error is kept; 5 s if it is not set.", examples=["5 s"]
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
    frames_rate: float = Field(
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

    read_before: ClassVar[tuple[str, ...]] = ("arguments", "include")
    """Keys of the file that are taken out of it before the model sees it."""

    name: Name = Field(description="Name of the robot.", examples=["bioloid_torso"])
    buses: dict[Name, Bus] = Field(
        min_length=1, description="Serial lines by name.", examples=["{main: {port: sim, ...}}"]
    )
    loop: Loop = Field(description="The control loop.", examples=["{rate: 50}"])
    joints: dict[Name, JointEntry] = Field(
        min_length=1, description="Joints by name.", examples=["{head_joint: {bus: main, id: 1, ...}}"]
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
