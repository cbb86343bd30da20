"""Robot: the form of a robot file. `compile` checks its sections against each other."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Annotated, ClassVar, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Discriminator,
    Field,
    Tag,
    WithJsonSchema,
)

from dxlrun.description import units
from dxlrun.description.bus import Bus
from dxlrun.description.form import Form, Name, PlugInEntry, key, refuse, with_keys
from dxlrun.description.joints.joints import JointEntry, joint_form
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
from dxlrun.features import installed_features, stages
from dxlrun.features.feature import PolicyKey, Section


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
    """Settings of the operating system for the loop."""

    policy: Literal["other", "fifo", "round_robin"] = key("Scheduling policy.", "round_robin", "other")
    priority: int = key("Real-time priority; only for fifo and round_robin.", "31", 31, ge=1, le=99)
    lock_memory: bool = key("Keep all memory in RAM.", "true", False)
    cores: (
        Annotated[
            tuple[Annotated[int, Field(ge=0, le=1023)], ...], Field(strict=False), AfterValidator(_cores)
        ]
        | None
    ) = key("Processor cores that the loop may run on.", "[3]", None)
    polling: AutoDuration = key(
        "Longest time that the clock is polled before a deadline; auto: a tenth of the period.",
        "100 us",
        "auto",
    )
    reply_polling: Polling = key(
        "Longest time that a servo's reply is polled for, at most half of a core; auto: a tenth.", "100 us", 0
    )
    idle_latency: bool = key("Keep processor cores from deep idle states.", "true", False)


class Loop(Form):
    """The control loop."""

    rate: Rate = key("Cycles per second, Hz.", "50", ge=0.001, le=100_000)
    scheduler: Scheduler = key("Real-time settings of the loop.", "{policy: round_robin}", Scheduler())
    overrun: Literal["skip", "catch_up", "stop"] = key(
        "After a late cycle whole periods are skipped, or up to 5 follow at once, or the run ends.",
        "catch_up",
        "skip",
    )
    tolerated_skips: Share = key("A run that skips more of its periods than this has failed.", "1 %", 0.1)


class PoseStep(Form):
    """A step of a policy that moves to a pose."""

    pose: str = key("Name of a pose.", "home", min_length=1)
    speed: Annotated[AngularVelocity, Field(gt=0)] = key("How fast each joint goes there.", "60 deg/s")
    linear_speed: Annotated[LinearVelocity, Field(gt=0)] | None = key(
        "How fast each linear joint goes there.", "20 mm/s", None
    )


class TorqueStep(Form):
    """A step of a policy that reduces the torque gradually."""

    reduce_torque: float = key("What is left of each servo's own torque limit.", "0.3", gt=0, lt=1)
    steps: int = key("In how many steps.", "5", 5, ge=1, le=100)
    over: Annotated[Duration, Field(gt=0)] = key("How long it takes.", "1 s", 1_000_000_000)


Word = Literal["limp", "hold"]  # torque off; or torque on, every joint holding its position


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
WrittenPolicy = Annotated[
    Annotated[Word, Tag("<word>")]
    | Annotated[tuple[PolicyStep, ...], Field(strict=False, min_length=1), Tag("<steps>")],
    Discriminator(_kind_of_policy),
]
"""Steps of a policy, in the order of execution. After the last step the robot is limp, unless that step is
`hold`."""


class Group(Form):
    """Joints under one name. Its other keys have been copied into the joints when the file was read."""

    joints: Annotated[tuple[Name, ...], Field(strict=False, min_length=1)] = key(
        "Its joints, or other groups.", "[left_shoulder, left_elbow]"
    )


class GroupPolicies(Form):
    """Policies of a group of joints that differ from those of the robot."""

    joints: Annotated[tuple[Name, ...], Field(strict=False)] = key(
        "Its joints, each in one at most; where it has none: the robot's group of that name.",
        "[left_wheel, right_wheel]",
        (),
    )
    on_returned_servo: Word | None = key("As the policy of that name, for this group.", "hold", None)


class Policies(Form):
    """Actions at the end of a run and on faults."""

    on_exit: WrittenPolicy = key(
        "At Ctrl-C, SIGTERM, `dxlrun stop` and the end of the motions.",
        "[{pose: home, speed: 60 deg/s}, limp]",
        "limp",
    )
    on_fault: WrittenPolicy = key(
        "When a controller failed without a fallback, a bus is gone, or by `overrun: stop`.", "limp", "limp"
    )
    on_returned_servo: Word = key(
        "When a servo answers again that has rebooted; hold: it gets torque where it stands.", "hold", "limp"
    )
    groups: dict[Name, GroupPolicies] = key(
        "Groups of joints with policies of their own for lost servos.",
        "{wheels: {joints: [left_wheel, right_wheel], on_lost_servo: limp}}",
        {},
    )
    exit_timeout: Duration = key("Longest orderly end of a run.", "2 s", 2_000_000_000, gt=0)

    def of_joint(self, name: str, joint: str) -> object:
        """Return the value of a key for a joint: its group's, or the robot's if the group has none."""
        groups = (group for group in self.groups.values() if joint in group.joints)
        values = (getattr(owner, name, None) for owner in (*groups, self))
        return next((value for value in values if value is not None), None)


def policies_form() -> type[Policies]:
    """Return the form of the section with the keys of all features."""
    keys = [each for _, each in stages(PolicyKey, installed_features())]
    group = with_keys(GroupPolicies, [each.group for each in keys if each.group is not None])
    return with_keys(Policies, keys, groups=dict[Name, group])  # type: ignore[valid-type]  # made at run time


_ONE_OR_MORE = {"anyOf": [{"type": "string"}, {"type": "array", "minItems": 1, "items": {"type": "string"}}]}


class ControllerEntry(PlugInEntry):
    """One controller. Keys other than type, active, rate, fallback and into are its own parameters."""

    type: str = key("Type that a plug-in offers.", "joint_group_position_controller", min_length=1)
    active: bool = key("Active from the start.", "false", True)
    rate: Annotated[float, Field(ge=0.001), units.rate] | None = key(
        "Updates per second, Hz; the loop's when absent.", "50", None
    )
    fallback: str | None = key(
        "Controller that takes over when this one breaks its contract.", "stand_still", None, min_length=1
    )
    into: Annotated[tuple[str, ...], BeforeValidator(_one_or_more), WithJsonSchema(_ONE_OR_MORE)] = key(
        "Controllers whose references this one commands, instead of the servos: one, or a list.",
        "arm_pid",
        (),
    )


class Gateway(Form):
    """The process through which clients steer the run."""

    enabled: bool = key("Let this user's programs steer the run.", "false", True)


class Processes(Form):
    """Processes next to the loop."""

    refused: ClassVar[Mapping[str, str]] = {"view": "take it out; `dxlrun view` shows a run"}

    gateway: Gateway = key("Steering from outside, over a Unix socket.", "{enabled: false}", Gateway())


class RobotModel(Form):
    """The robot's body."""

    urdf: str = key(
        "Its URDF, from the folder of the file that says it; goes into the log.", "torso.urdf", min_length=1
    )
    frames_rate: Rate = key("Messages of /tf in the log a second, Hz; 0: none.", "10", 30.0, ge=0, le=100_000)
    imu: Name | None = key(
        "Sensor, device or controller whose orientation turns the body in the frame odom.", "imu", None
    )
    imu_link: str | None = key(
        "Link of the URDF whose orientation that is; NAME, NAME_link or NAME_frame when absent.",
        "torso",
        None,
        min_length=1,
    )


class Simulation(Form):
    """Physics of the simulated servos' loads; servos on a real port ignore it."""

    physics: Literal["independent", "mujoco"] = key(
        "Each joint by itself, or all together by MuJoCo after the model's URDF.", "mujoco", "independent"
    )


_POLICIES = ("What happens on faults and at the end.", "{exit_timeout: 2 s}")


class Robot(Form):
    """A robot file without its arguments: the sections that are not features.

    `robot_form` adds the sections of features; `Section.of` returns one of them.
    """

    read_before: ClassVar[tuple[str, ...]] = ("arguments", "include", "joint_defaults")
    """Keys of the file that are removed before the model is validated."""

    name: Name = key("Name of the robot.", "bioloid_torso")
    buses: dict[Name, Bus] = key("Serial lines by name.", "{main: {port: sim, ...}}", min_length=1)
    loop: Loop = key("The control loop.", "{rate: 50}")
    joints: dict[Name, JointEntry] = key(
        "Joints by name.", "{head_joint: {bus: main, id: 1, ...}}", min_length=1
    )
    groups: dict[Name, Group] = key(
        "Joints under one name, with keys that each of them gets.",
        "{left_arm: {bus: main, joints: [left_shoulder, left_elbow]}}",
        {},
    )
    controllers: dict[Name, ControllerEntry] = key(
        "Controllers by name, updated in this order.", "{head: {type: ...}}", {}
    )
    poses: dict[Name, Annotated[dict[Name, Position], Field(min_length=1)]] = key(
        "Positions of some or all joints, by name, for policies.", "{home: {head_joint: 0 deg}}", {}
    )
    policies: Policies = key(*_POLICIES, Policies())
    processes: Processes = key("Processes beside the loop.", "{gateway: {enabled: false}}", Processes())
    model: RobotModel | None = key("The robot's body.", "{urdf: torso.urdf}", None)
    simulation: Simulation = key(
        "How simulated servos move what they move.", "{physics: mujoco}", Simulation()
    )


@cache
def robot_form() -> type[Robot]:
    """Return the form of a robot file with the sections of all features."""
    policies = policies_form()
    sections = [section for _, section in stages(Section, installed_features())]
    return with_keys(
        Robot,
        [Section("policies", policies, key(*_POLICIES, policies())), *sections],
        joints=dict[Name, joint_form()],  # type: ignore[misc]  # made at run time
    )
