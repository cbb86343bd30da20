"""Robot: the form of a robot file, apart from the sections that features add."""

from collections.abc import Mapping
from functools import cache, reduce
from operator import or_
from types import GenericAlias
from typing import Annotated, Any, ClassVar, Literal, get_args

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Discriminator,
    Field,
    Tag,
    WithJsonSchema,
)

from dxlrun.description import units
from dxlrun.description.base_form import Form, Name, PlugInEntry, key, validation_error, with_keys
from dxlrun.description.bus import Bus
from dxlrun.description.joints.joint_forms import JointEntry, joint_form
from dxlrun.description.mistakes.words import words_for
from dxlrun.description.units import (
    AngularVelocity,
    AutoDuration,
    Duration,
    LinearVelocity,
    Polling,
    Position,
    Rate,
    Share,
)
from dxlrun.errors import suggestion
from dxlrun.features import installed_features, stages
from dxlrun.features.feature import PolicyKey, PoseStage, Section
from dxlsim.texts.duration import split_quantity


def _cores(value: tuple[int, ...]) -> tuple[int, ...]:
    if not value or len(set(value)) < len(value):
        raise validation_error("cores must be a list of different cores", "write for example [3]")
    return value


def _one_or_more(value: object) -> object:
    if isinstance(value, str):
        return (value,)
    if not isinstance(value, list) or not value:
        raise validation_error("this is not the name of a controller", "write a name, or a list: [a, b]")
    return tuple(value)


class Scheduler(Form):
    """Form of `loop.scheduler`: real-time settings of the operating system for the loop's process."""

    policy: Literal["other", "fifo", "round_robin"] = key(
        "Linux scheduling policy of the loop.", "round_robin", "other"
    )
    priority: int = key(
        "Real-time priority for fifo and round_robin; 98 at most, because the guardian needs a higher one.",
        "31",
        31,
        ge=1,
        le=99,
    )
    lock_memory: bool = key("Memory lock, which keeps the loop from being swapped out.", "true", False)
    cores: (
        Annotated[
            tuple[Annotated[int, Field(ge=0, le=1023)], ...], Field(strict=False), AfterValidator(_cores)
        ]
        | None
    ) = key("Processor cores on which the loop may run.", "[3]", None)
    polling: AutoDuration = key(
        "Longest time of polling the clock before a deadline; auto is a tenth of the period.",
        "100 us",
        "auto",
    )
    reply_polling: Polling = key(
        "Longest time of polling for a servo's reply; it takes at most half of a core. `auto` is 1 ms and "
        "a tenth of a core. Off by default.",
        "100 us",
        0,
    )
    idle_latency: bool = key(
        "Lock against deep idle states, from which processor cores wake late.", "true", False
    )


class Loop(Form):
    """Form of the section `loop`: rate of the control loop, real-time settings, late cycles."""

    rate: Rate = key("Loop rate, Hz.", "50", ge=0.001, le=100_000)
    scheduler: Scheduler = key(
        "Real-time settings of the loop.", "{policy: round_robin}", Scheduler.of_defaults()
    )
    overrun: Literal["skip", "catch_up", "stop"] = key(
        "Reaction to a late cycle: skip the missed periods, run up to 5 late cycles "
        "without waiting (catch_up), or end the run (stop).",
        "catch_up",
        "skip",
    )
    tolerated_skips: Share = key("Largest share of skipped periods in a good run.", "1 %", 0.1)


class PoseStep(Form):
    """Form of a policy's step that moves joints to a named pose."""

    pose: str = key("Name of the pose.", "home", min_length=1)
    speed: Annotated[AngularVelocity, Field(gt=0)] = key(
        "Speed of each rotary joint on its way to the pose.", "60 deg/s"
    )
    linear_speed: Annotated[LinearVelocity, Field(gt=0)] | None = key(
        "Speed of each linear joint on its way to the pose; required if the pose has linear joints.",
        "20 mm/s",
        None,
    )


class TorqueStep(Form):
    """Form of a policy's step that reduces the servos' torque gradually."""

    reduce_torque: float = key(
        "Remaining share of each servo's own torque limit, between 0 and 1.", "0.3", gt=0, lt=1
    )
    steps: int = key("Number of steps of the reduction.", "5", 5, ge=1, le=100)
    over: Annotated[Duration, Field(gt=0)] = key("Duration of the reduction.", "1 s", 1_000_000_000)


Word = Literal["limp", "hold"]  # torque off; or torque on, every joint holding its position


def _step_word(value: object) -> object:
    """Refuse a text that is not `limp` or `hold`, such as the name of a pose, which needs a speed."""
    if isinstance(value, str) and value not in get_args(Word):
        steps = f"write limp, hold, or steps such as [{{pose: {value}, speed: 60 deg/s}}, limp]"
        raise ValueError(f"{value!r} is not a step; {suggestion(value, get_args(Word), steps)}")
    return value


StepWord = Annotated[Word, BeforeValidator(_step_word, json_schema_input_type=Word)]


def _kind_of_step(step: object) -> str:
    if isinstance(step, dict):
        return "<torque>" if "reduce_torque" in step else "<pose>"
    if isinstance(step, TorqueStep):
        return "<torque>"
    return "<pose>" if isinstance(step, PoseStep) else "<word>"


def _kind_of_policy(policy: object) -> str:
    return "<steps>" if isinstance(policy, list | tuple | dict) else "<word>"


PolicyStep = Annotated[
    Annotated[StepWord, Tag("<word>")]
    | Annotated[PoseStep, Tag("<pose>")]
    | Annotated[TorqueStep, Tag("<torque>")],
    Discriminator(_kind_of_step),
]
WrittenPolicy = Annotated[
    Annotated[StepWord, Tag("<word>")]
    | Annotated[tuple[PolicyStep, ...], Field(strict=False, min_length=1), Tag("<steps>")],
    Discriminator(_kind_of_policy),
]
"""Form of a policy: `limp`, `hold`, or a list of steps in the order of execution. After the last step the
robot is limp, unless that step is `hold`."""


class Group(Form):
    """Form of a group of joints; other keys than `joints` were copied into the joints before."""

    joints: Annotated[tuple[Name, ...], Field(strict=False, min_length=1)] = key(
        "Joints of the group, or other groups.", "[left_shoulder, left_elbow]"
    )


class GroupPolicies(Form):
    """Form of an entry of `policies.groups`: policies of some joints that differ from the robot's."""

    joints: Annotated[tuple[Name, ...], Field(strict=False)] = key(
        "Joints of the group, each in one group at most; by default those of the robot's group with "
        "this name.",
        "[left_wheel, right_wheel]",
        (),
    )
    on_returned_servo: Word | None = key(
        "State of a servo that answers again after a reboot; the robot's policy by default.",
        "hold",
        None,
    )


class Policies(Form):
    """Form of the section `policies`: what the robot does when a run ends or a fault occurs."""

    on_exit: WrittenPolicy = key(
        "Steps at the end of a run without a fault, as by Ctrl-C, SIGTERM, `dxlrun stop` or the last motion.",
        "[{pose: home, speed: 60 deg/s}, limp]",
        "limp",
    )
    on_fault: WrittenPolicy = key(
        "Steps after a fault, such as a lost bus, a failed controller without a fallback, or a late "
        "cycle with `overrun: stop`.",
        "limp",
        "limp",
    )
    on_returned_servo: Word = key(
        "State of a servo that answers again after a reboot: limp, or with torque at its present "
        "position (hold).",
        "hold",
        "limp",
    )
    groups: dict[Name, GroupPolicies] = key(
        "Groups of joints with their own policies for lost and returned servos.",
        "{wheels: {joints: [left_wheel, right_wheel], on_lost_servo: limp}}",
        {},
    )
    exit_timeout: Duration = key(
        "Time limit for the end of a run, including the steps of its policy.", "2 s", 2_000_000_000, gt=0
    )

    def of_joint(self, name: str, joint: str) -> object:
        """Return a policy's value for a joint: that of its group, or of the robot if the group has none."""
        groups = (group for group in self.groups.values() if joint in group.joints)
        values = (getattr(owner, name, None) for owner in (*groups, self))
        return next((value for value in values if value is not None), None)


def policies_form() -> type[Policies]:
    """Return the form of `policies`, extended by the keys of installed features."""
    keys = [each for _, each in stages(PolicyKey, installed_features())]
    group = with_keys(GroupPolicies, [each.group for each in keys if each.group is not None])
    return with_keys(Policies, keys, groups=dict[Name, group])  # type: ignore[valid-type]  # made at run time


_ONE_OR_MORE = {"anyOf": [{"type": "string"}, {"type": "array", "minItems": 1, "items": {"type": "string"}}]}


class ControllerEntry(PlugInEntry):
    """Form of one controller. Keys other than type, active, rate, fallback and into are its parameters."""

    type: str = key(
        "Controller type of a plug-in, or a class of a Python file: `./wave.py:Wave`.",
        "joint_group_position_controller",
        min_length=1,
    )
    active: bool = key("Activation at the start of the run.", "false", True)
    rate: Annotated[float, Field(ge=0.001), units.rate] | None = key(
        "Update rate, Hz; the loop rate by default.", "50", None
    )
    fallback: str | None = key(
        "Controller that takes over when this controller fails.", "stand_still", None, min_length=1
    )
    into: Annotated[tuple[str, ...], BeforeValidator(_one_or_more), WithJsonSchema(_ONE_OR_MORE)] = key(
        "Controllers that get the commands of this controller as references, instead of the servos: "
        "one name or a list.",
        "arm_pid",
        (),
    )


class Gateway(Form):
    """Form of `processes.gateway`: the process through which clients steer the run."""

    enabled: bool = key("Permission for other programs of this user to steer the run.", "false", True)


class Processes(Form):
    """Form of the section `processes`: processes next to the loop."""

    refused: ClassVar[Mapping[str, str]] = {"view": "remove it; `dxlrun view` shows a run"}

    gateway: Gateway = key(
        "Access for programs that steer the run, over a Unix socket.",
        "{enabled: false}",
        Gateway.of_defaults(),
    )


class RobotModel(Form):
    """Form of the section `model`: the robot's URDF, its IMU, and the frames in the log."""

    urdf: str = key(
        "URDF of the robot, relative to the folder of the file that names it; each log contains a copy.",
        "torso.urdf",
        min_length=1,
    )
    frames_rate: Rate = key("Rate of /tf messages in the log, Hz; 0 for none.", "10", 30.0, ge=0, le=100_000)
    imu: Name | None = key(
        "Sensor, device or controller that provides the orientation of the body in the frame odom.",
        "imu",
        None,
    )
    imu_link: str | None = key(
        "URDF link of the IMU; by default the value of `imu`, alone or followed by _link or _frame.",
        "torso",
        None,
        min_length=1,
    )


class Simulation(Form):
    """Form of the section `simulation`: physics of the simulated servos' loads; real servos ignore it."""

    physics: Literal["independent", "mujoco"] = key(
        "Physics engine: each joint on its own (independent), or the whole robot in MuJoCo, from the "
        "URDF of `model`.",
        "mujoco",
        "independent",
    )


_POLICIES = ("Actions on faults and at the end of a run.", "{exit_timeout: 2 s}")


class Robot(Form):
    """Form of a robot file without the sections of features, which `robot_form` adds.

    `robot_form` adds the sections of features; `Section.section_of` returns one of them.
    """

    read_before: ClassVar[tuple[str, ...]] = ("arguments", "include", "joint_defaults")
    """Keys of the file that are used and removed before it is validated by this form."""

    name: Name = key("Name of the robot.", "bioloid_torso")
    buses: dict[Name, Bus] = key("Serial lines by name.", "{main: {port: sim, ...}}", min_length=1)
    loop: Loop = key("Rate and real-time settings of the control loop.", "{rate: 50}")
    joints: dict[Name, JointEntry] = key(
        "Joints by name.", "{head_joint: {bus: main, id: 1, ...}}", min_length=1
    )
    groups: dict[Name, Group] = key(
        "Groups of joints by name, with keys for each joint of the group.",
        "{left_arm: {bus: main, joints: [left_shoulder, left_elbow]}}",
        {},
    )
    controllers: dict[Name, ControllerEntry] = key(
        "Controllers by name, in the order of their updates.", "{head: {type: ...}}", {}
    )
    poses: dict[Name, dict[Name, Position] | Form] = key(
        "Poses by name, for policies, motions, keyframes and clients: positions of some or all joints, or "
        "the form of a feature.",
        "{home: {head_joint: 0 deg}}",
        {},
    )
    policies: Policies = key(*_POLICIES, Policies.of_defaults())
    processes: Processes = key(
        "Processes next to the loop.", "{gateway: {enabled: false}}", Processes.of_defaults()
    )
    model: RobotModel | None = key("URDF and frames of the robot.", "{urdf: torso.urdf}", None)
    simulation: Simulation = key(
        "Physics of the simulated servos' loads.", "{physics: mujoco}", Simulation.of_defaults()
    )


def pose_stages() -> list[PoseStage[Any]]:
    """Return the forms of poses of installed features."""
    return [stage for _, stage in stages(PoseStage, installed_features())]


def pose_form() -> object:
    """Return the pydantic type of a pose: positions by joint, or the form of a feature.

    A pose in the form of a feature has a text that is not a quantity: with the feature's key or a foreign
    term for it, or with a list, next to another key of the form; or all required keys, without a text there.
    """
    forms = pose_stages()

    def kind_of_pose(pose: object) -> str:
        values = pose if isinstance(pose, dict) else {}
        texts = {key for key, at in values.items() if isinstance(at, str) and split_quantity(at) is None}
        listed = any(isinstance(at, list) for at in values.values())  # such as `rpy`
        for one in forms:
            keys, named = one.form.model_fields.keys(), {one.name, *words_for(one.form.__name__, [one.name])}
            needed = {key for key, field in one.form.model_fields.items() if field.is_required()}
            is_whole = needed <= values.keys() and not isinstance(values.get(one.name, ""), str)
            if texts & named or ((texts - keys or listed) and values.keys() & keys) or is_whole:
                return f"<{one.name}>"
        return "<joints>"

    by_joint = Annotated[dict[Name, Position], Field(min_length=1), Tag("<joints>")]
    others = (Annotated[one.form, Tag(f"<{one.name}>")] for one in forms)
    return Annotated[reduce(or_, others, by_joint), Discriminator(kind_of_pose)] if forms else by_joint


@cache
def robot_form() -> type[Robot]:
    """Return the form of a robot file, extended by the sections and keys of installed features."""
    policies = policies_form()
    sections = [section for _, section in stages(Section, installed_features())]
    return with_keys(
        Robot,
        [Section("policies", policies, key(*_POLICIES, policies.of_defaults())), *sections],
        joints=GenericAlias(dict, (Name, joint_form())),
        poses=GenericAlias(dict, (Name, pose_form())),
    )
