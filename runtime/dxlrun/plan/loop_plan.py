"""Loop plan: period, scheduler requests, joints, controllers and timed commands; JSON in the log."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import msgspec

from dxlrun.description.joints.servo_model import ServoModel
from dxlrun.description.joints.turns import nearest_turn
from dxlrun.description.source_names import SOURCE_COMMANDS
from dxlrun.features import FEATURES
from dxlrun.features.feature import Feature
from dxlrun.plan.policy_plan import SLOW_SPEEDS, PolicyPlan
from dxlsim.motor_model import MotorModel
from dxlwire.joint_unit import LINEAR, ROTARY, JointUnit
from dxlwire.modes import Mode, mode_of

if TYPE_CHECKING:
    from dxlrun.channels.cycle import CycleLayout

TOLERATED_SKIPS = 0.1
"""Default share of skipped periods up to which a run counts as good. A loop at 50 Hz with simulated servos,
without real-time rights and with five busy programs on two cores, skipped 2.6 % [measured]."""

Policy = Literal["other", "fifo", "round_robin"]
OverrunPolicy = Literal["skip", "catch_up", "stop"]
"""Handling of deadlines that passed during a late cycle."""
ScheduleName = Literal["absolute", "sequential"]
"""Rule for deadlines, see `control/schedule.py`. `sequential` is not a key of the robot file. It is the
baseline of `dxlrun experiment tracking`."""

GOAL_TOLERANCES: Mapping[JointUnit, float] = {ROTARY: math.radians(5.0), LINEAR: 0.005}
"""Default tolerance of a goal, rad or m. The same number is the default speed below which a joint is at rest,
rad/s or m/s."""
SETTLE_NS = 1_000_000_000
"""Default time after the end of a motion in which joints may still reach the goal, ns."""
UNLIMITED = 1e300
"""Replaces an infinite tolerance, because JSON does not have infinity."""

MOST_SHARE = 2
"""Divider of the period for the longest polling of the clock. Other processes need the rest of the core."""


class SchedulerPlan(msgspec.Struct, frozen=True):
    """Requests to the operating system; `realtime` reports what was granted."""

    policy: Policy
    priority: int
    lock_memory: bool
    cores: tuple[int, ...] = ()  # Cores of the loop; empty: all
    polling_ns: int | None = None
    """Longest polling of the clock before a deadline; None: a tenth of the period."""
    reply_polling_ns: int | None = None
    """Longest polling for a reply, 0: none; None: a tenth of a core."""
    idle_latency: bool = False  # Keep the cores out of deep idle states


LimitedInterface: TypeAlias = Literal["velocity", "effort", "pwm"]
"""Command interfaces whose magnitude a register of a servo may limit."""


class ServoLimit(msgspec.Struct, frozen=True):
    """Limit in a servo's register that applies to goals, read at start-up or when the servo returned."""

    interface: LimitedInterface
    value: float  # Highest magnitude of a goal: rad/s or m/s, the unit of the effort, share of the voltage
    text: str  # Register and value: `Current Limit (38) = 20, 0.0538 A`


class JointPlan(msgspec.Struct, frozen=True):
    """A joint with its limits. All arrays have one element a joint, in the order of the plan's joints."""

    name: str
    lower: float  # rad or m; the tighter one of the file's limit and the servo's range
    upper: float
    velocity: float | None
    """rad/s or m/s; the servo's top speed if the file has no limit. None: not known, or a log from before
    acceleration limits, which is replayed without a limit."""
    effort: float | None = None
    """Nm, A or the fraction of maximum, in the unit that the model measures; None: no limit in the file."""
    continuous: bool = False  # A wheel, or a joint of several turns
    bounded: bool = True
    """True if `lower` and `upper` also limit velocity, effort and PWM. False for a continuous joint without
    limits in the file: a wheel."""
    top_speed: float | None = None  # Top speed of the servo, rad/s or m/s; None: not known
    top_effort: float | None = None
    """Highest effort goal of the servo, in the unit of `effort`; None: not known, or no effort goals."""
    acceleration: float | None = None
    """Acceleration limit of goals, rad/s^2 or m/s^2; None: no limit in the file."""
    servo: str = ""  # ID and bus, for messages
    motor: MotorModel | None = None
    """Motor of its servo, from the motor file in the robot file; None: the robot file has none."""
    servo_model: ServoModel | None = None  # Data of its servo from the manual; None: several servos move it

    unit: JointUnit = ROTARY
    """Unit of positions. The units of speeds, accelerations and torques follow from it."""
    coupled: tuple[str, ...] = ()
    """Joints that the same servos move, including this one; empty: only this one."""
    tolerance: float | None = None
    """Tolerance of goals, rad or m; UNLIMITED: not checked; None: the default."""
    rest_speed: float | None = None
    """Speed below which the joint is at rest, rad/s or m/s; UNLIMITED: not checked; None: the default."""
    settle_ns: int = SETTLE_NS
    """Settling time of goals after the end of a motion."""
    wrap: bool = False  # A continuous joint whose position is the same after a full turn
    servo_limits: tuple[ServoLimit, ...] = ()
    """Limits in registers of its servos; empty in the plan, because they are read at start-up."""
    keys: dict[str, object] = {}
    """Keys of features with their values in SI units; `JointKey.value_of` returns a value with its type."""

    @property
    def label(self) -> str:
        """Name of the joint with its servo, for messages."""
        return f"{self.name} ({self.servo})" if self.servo else self.name

    @property
    def highest_speed(self) -> float:
        """Highest speed of goals: minimum of file's limit, servo's top speed and registers, rad/s or m/s."""
        return self._highest("velocity")

    @property
    def step_speed(self) -> float:
        """Speed limit for the steps between goals, rad/s or m/s.

        If the file limits the speed, the speed is sent with each goal, so a register of the servo limits the
        steps too. Without a limit in the file, a servo moves to a position as fast as it can.
        """
        speed = _or_inf(self.velocity)
        return min(speed, self.highest_speed) if speed < _or_inf(self.top_speed) else speed

    @property
    def highest_effort(self) -> float:
        """Highest effort of goals: minimum of file's limit, servo's limit and registers; unit as `effort`."""
        return self._highest("effort")

    @property
    def highest_pwm(self) -> float:
        """Highest PWM: 1, the full voltage, or less if a register of the servo limits it."""
        return self._highest("pwm")

    @property
    def immovable(self) -> str:
        """Sentence about a register whose limit of 0 prevents motion to a position.

        Empty: the joint can move.
        """
        own = self.find_servo_limit("velocity")
        return "" if own is None or own.value else f"{self.label} cannot move, as its servo has {own.text}"

    def find_servo_limit(self, interface: LimitedInterface) -> ServoLimit | None:
        """Return the servo's register that is a tighter limit than file and manual, or None."""
        own = next((one for one in self.servo_limits if one.interface == interface), None)
        return None if own is None or own.value >= self._planned_limit(interface) else own

    @property
    def binding_servo_limits(self) -> tuple[ServoLimit, ...]:
        """Registers of the servos that limit goals more tightly than file and manual."""
        return tuple(own for own in self.servo_limits if self.find_servo_limit(own.interface))

    def exceeds_file_limit(self, interface: LimitedInterface) -> bool:
        """Return whether a servo's register is tighter than a limit that the robot file sets."""
        given = self.velocity != self.top_speed and not self.coupled if interface == "velocity" else True
        limits = {"velocity": self.velocity, "effort": self.effort, "pwm": None}
        return given and limits[interface] is not None and self.find_servo_limit(interface) is not None

    def describe_servo_limit(self, own: ServoLimit) -> str:
        """Return a text about the effect of a register, with a remedy if the file allows more."""
        held = f"goals of {own.interface} are held to {own.text}"
        if not self.exceeds_file_limit(own.interface):
            return held
        key = f"limits.{own.interface}"
        return f"{held}, tighter than `{key}` in the robot file; lower `{key}`, or raise the register"

    def _highest(self, interface: LimitedInterface) -> float:
        own = self.find_servo_limit(interface)
        return self._planned_limit(interface) if own is None else own.value

    def _planned_limit(self, interface: LimitedInterface) -> float:
        if interface == "velocity":
            return min(_or_inf(self.velocity), _or_inf(self.top_speed))
        return min(_or_inf(self.effort), _or_inf(self.top_effort)) if interface == "effort" else 1.0

    @property
    def goal_tolerance(self) -> float:
        """Distance from a goal within which the joint has reached it, rad or m."""
        return GOAL_TOLERANCES[self.unit] if self.tolerance is None else self.tolerance

    @property
    def highest_rest_speed(self) -> float:
        """Speed below which the joint counts as at rest, rad/s or m/s."""
        return GOAL_TOLERANCES[self.unit] if self.rest_speed is None else self.rest_speed

    def way(self, begin: float, end: float) -> float:
        """Return the signed distance from one position to another; the shorter one if the joint wraps."""
        return (nearest_turn(end, begin) if self.wrap else end) - begin

    @property
    def slow_speed(self) -> float:
        """Speed limit of its goals in the first second after torque was enabled, rad/s or m/s."""
        return SLOW_SPEEDS[self.unit]

    @property
    def rest_mode(self) -> Mode:
        """Mode that the joint enters without a command if it would not hold still in its current mode."""
        return Mode.VELOCITY if self.continuous else Mode.POSITION


class JointProperty(msgspec.Struct, frozen=True):
    """A property of joints that `dxlrun check` or a running robot shows."""

    name: str  # Key in the JSON of `check`, and heading of its column
    value: Callable[[JointPlan], object]  # Returns the value in SI units; None: not known
    column: str | None = None
    """Unit in the table of `check`, a suffix to that of positions: `/s`. None: not in the table."""
    limit: bool = False
    """True for a key of `limits` in the robot file, whose default is the servo's own value."""
    listed: str = ""  # Field of `JointValues` with the property; empty: none
    text: Callable[[object, JointUnit], str] | None = None
    """Formats a value without a unit of positions or speeds; None: the value has one."""


JOINT_PROPERTIES: tuple[JointProperty, ...] = (
    JointProperty("unit", lambda joint: joint.unit.si, listed="units"),
    JointProperty(
        "limits", lambda joint: (joint.lower, joint.upper) if joint.bounded else None, listed="limits"
    ),
    JointProperty("highest speed", lambda joint: joint.highest_speed, listed="speeds"),
    JointProperty("velocity", lambda joint: joint.velocity, column="/s", limit=True),
    JointProperty("acceleration", lambda joint: joint.acceleration, column="/s^2"),
)
"""Properties in the order of the columns of `check`; the keys of features follow."""


@dataclass(frozen=True)
class JointValues:
    """Properties of all joints by name, as clients of a running robot get them."""

    units: dict[str, str]
    """Unit of each joint's positions."""
    effort_units: dict[str, str]
    limits: dict[str, tuple[float, float]]
    """Lowest and highest position of each joint with limits."""
    speeds: dict[str, float | None]
    """Highest speed of each joint, rad/s or m/s; null: no limit."""
    joint_keys: dict[str, dict[str, object]]
    """Values of the keys of features in the robot file, by key and joint."""

    @classmethod
    def from_joints(cls, joints: Sequence[JointPlan], effort_units: dict[str, str]) -> JointValues:
        """Return the properties of joints. Units of effort depend on the servo models."""
        values: dict[str, object] = {
            one.listed: {joint.name: value for joint in joints if (value := one.value(joint)) is not None}
            for one in JOINT_PROPERTIES
            if one.listed
        }
        keys = {
            key: {joint.name: joint.keys[key] for joint in joints if key in joint.keys}
            for key in dict.fromkeys(key for joint in joints for key in joint.keys)
        }
        return msgspec.convert(values | {"effort_units": effort_units, "joint_keys": keys}, cls)


def _or_inf(limit: float | None) -> float:
    return math.inf if limit is None else limit


class SourcePlan(msgspec.Struct, frozen=True):
    """A device or sensor: an entry of a feature's section that has states or commands."""

    name: str
    kind: str  # Noun for messages: `device`
    states: tuple[str, ...]  # Names of its states: `angular_velocity.x`
    commands: tuple[str, ...] = ()  # Names of its commands: `led`
    ranges: tuple[tuple[float, float], ...] = ()  # Lowest and highest value of each command, SI units
    label: str = ""  # Name in messages: `imu (ID 241 on bus main)`
    commandable: bool = False  # Its entry in the file may name commands
    units: dict[str, str] = {}
    """SI units of states by name; empty in logs of earlier versions."""
    command_units: dict[str, str] = {}
    """SI units of commands by name."""


class RegisterPlan(msgspec.Struct, frozen=True):
    """Value that a controller may write into a register of a joint's servos."""

    joint: str
    item: str
    value: int | str  # As in the robot file
    writes: tuple[tuple[int, int], ...] = ()
    """Row (`Hardware.write_register`) and integer on the wire of each servo."""


class ControllerPlan(msgspec.Struct, frozen=True):
    """Compiled entry of one controller in the robot file."""

    name: str
    type: str
    distribution: str  # Publisher of the plug-in: `name version`
    parameters: str  # JSON that `Parameters` accepts
    joints: tuple[str, ...]
    command: tuple[str, ...]  # Claimed command interfaces
    publishes: tuple[str, ...]
    active: bool
    every: int  # Updated every n-th cycle
    rate: float | None = None  # Rate of updates in the robot file, Hz; None: the loop's rate
    fallback: str = ""
    """Controller that takes over when this one breaks its contract; empty: none."""
    into: tuple[str, ...] = ()  # Controllers whose references it commands; empty: it commands the servos
    reference: tuple[str, ...] = ()
    """Interfaces that it exports for each of its joints, for controllers that are `into` this one."""
    reads: tuple[str, ...] = ()
    """Interfaces that it reads without a claim: `JOINT/position`, `CONTROLLER/JOINT/position`."""
    optional: tuple[str, ...] = ()  # Names in `reads` that it can do without
    topics: tuple[str, ...] = ()  # Its own topics: `/arm/state`
    provides: tuple[str, ...] = ()  # States that it provides: `orientation.x`
    source_commands: tuple[str, ...] = msgspec.field(default=(), name=SOURCE_COMMANDS)
    """Commands of sources that it claims: `light/led`. Logs have the name of the first kind of source."""
    takeovers: tuple[str, ...] = ()  # Controllers whose takeover it may request
    partial: bool = False  # It continues with the other joints while some have no torque
    registers: tuple[RegisterPlan, ...] = ()  # Registers that it may write, and their values

    @property
    def commands_servos(self) -> bool:
        """True if the controller commands servos, not references of other controllers."""
        return bool(self.command) and not self.into

    def split_group(self, joints: Iterable[JointPlan]) -> tuple[str, tuple[str, ...]] | None:
        """Return a joint whose mode would differ from that of joints with the same servos, and those joints.

        The controller does not claim them, so they stay in their rest mode, but a servo has only one mode.
        None: there is not any such joint.
        """
        if not self.commands_servos:
            return None
        mode = mode_of(self.command)
        for joint in joints:
            others = tuple(name for name in joint.coupled if name not in self.joints)
            if others and joint.name in self.joints and mode is not joint.rest_mode:
                return joint.name, others
        return None

    @property
    def references(self) -> tuple[str, ...]:
        """Names of the reference interfaces that it exports: `arm_pid/shoulder/position`."""
        return tuple(
            f"{self.name}/{joint}/{interface}" for interface in self.reference for joint in self.joints
        )


class ScheduledGoal(msgspec.Struct, frozen=True):
    """Goal of a played motion for one controller."""

    end_ns: int | None
    """End of the motion since the loop's first deadline, when the goal is judged. None: it is played until it
    is cancelled."""
    positions: tuple[float | None, ...] = ()
    """Target of each joint of the controller, rad or m; None: it must only be at rest. Empty: neither is
    checked."""


class ScheduledCommand(msgspec.Struct, frozen=True):
    """A command of a motion file for a controller, prepared, with the time at which it is due."""

    at_ns: int  # Time since the loop's first deadline
    controller: str
    kind: str
    data: bytes  # Little-endian float64
    origin: str  # Source position: `three_parts.yaml:7:5`
    request: str = ""  # Input of `prepare` as JSON
    goal: ScheduledGoal | None = None
    """Goal that starts with this command. The runtime pursues it if the command is not a goal of the
    controller."""


class LoopPlan(msgspec.Struct, frozen=True):
    """Compiled data of a robot that the loop needs, without buses and servos."""

    period_ns: int
    scheduler: SchedulerPlan
    joints: tuple[JointPlan, ...]
    controllers: tuple[ControllerPlan, ...]
    commands: tuple[ScheduledCommand, ...]  # Sorted by time
    end_ns: int | None  # End of the run since the first deadline; None: see `ends_with_goals`
    overrun: OverrunPolicy = "skip"
    ends_with_goals: bool = False  # A run without `end_ns` ends with its last goal
    tolerated_skips: float = TOLERATED_SKIPS  # Share of skipped periods up to which a run counts as good
    least_period_ns: int = 0  # Shortest period for the time budget of the buses; 0: not computed
    slowest_period_ns: int = 0  # Longest period for the Bus Watchdog; 0: unlimited
    policies: PolicyPlan = PolicyPlan()
    schedule: ScheduleName = "absolute"
    sources: tuple[SourcePlan, ...] = ()  # Devices, then sensors
    urdf: str | None = None  # Text of the robot's URDF; None: the robot file does not name one
    features: tuple[Feature, ...] = FEATURES
    """Features of the robot file whose code takes part in the run."""
    feature_plans: dict[str, bytes] = {}
    """Encoded plan of each feature, by name of the feature."""

    @property
    def origins(self) -> frozenset[str]:
        """Positions in motion files from which the plan's commands come."""
        return frozenset(command.origin for command in self.commands)

    @property
    def references(self) -> tuple[str, ...]:
        """Names of all reference interfaces, in the order of the cycle's record."""
        return tuple(name for controller in self.controllers for name in controller.references)

    @property
    def layout(self) -> CycleLayout:
        """Layout of the cycle records, from the names of joints, controllers and sources."""
        from dxlrun.channels.cycle import CycleLayout  # not above: the doctor reads plans without numpy

        return CycleLayout(
            tuple(one.name for one in self.joints),
            tuple(one.name for one in self.controllers),
            self.references,
            self.source_states,
            self.source_commands,
        )

    @property
    def source_states(self) -> dict[str, tuple[str, ...]]:
        """Names of the states of devices, sensors and controllers, in the order of the cycle's record."""
        return {one.name: one.states for one in self.sources} | {
            one.name: one.provides for one in self.controllers if one.provides
        }

    @property
    def source_units(self) -> dict[str, str]:
        """SI units of states: `imu/angular_velocity.x` -> `rad/s`."""
        return {f"{one.name}/{state}": unit for one in self.sources for state, unit in one.units.items()}

    @property
    def command_units(self) -> dict[str, str]:
        """SI units of the commands of sources, by `light/brightness`."""
        return {
            f"{one.name}/{command}": unit
            for one in self.sources
            for command, unit in one.command_units.items()
        }

    @property
    def source_commands(self) -> tuple[str, ...]:
        """Names of all commands of sources, in the order of the cycle's record."""
        return tuple(f"{one.name}/{command}" for one in self.sources for command in one.commands)
