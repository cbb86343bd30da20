"""What the loop executes: period, scheduler requests, controllers, commands by time; JSON in the log."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import msgspec

from dxlrun.description.joints.servo import ServoModel
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
"""As the robot file's default. Measured: 50 Hz, simulated servos, no real-time rights, two cores that five
programs want, skipped 2.6 %."""

Policy = Literal["other", "fifo", "round_robin"]
OverrunPolicy = Literal["skip", "catch_up", "stop"]
"""What becomes of deadlines that passed while a cycle was late."""
ScheduleName = Literal["absolute", "sequential"]
"""When cycles are due, see `control/schedule.py`. `sequential` has no key in the robot file: it is the
yardstick of `dxlrun experiment tracking`."""

GOAL_TOLERANCES: Mapping[JointUnit, float] = {ROTARY: math.radians(5.0), LINEAR: 0.005}
"""Default distance from a goal within which a joint has reached it, rad or m; within the same distance a
second it is at rest."""
SETTLE_NS = 1_000_000_000
"""Default time after the end of a motion in which its goal may still be reached."""
UNLIMITED = 1e300
"""Stands for an infinite tolerance: JSON has no infinity."""

MOST_SHARE = 2
"""One part in so many of the period is the most that the clock is polled: the rest is left to others."""


class SchedulerPlan(msgspec.Struct, frozen=True):
    """Requests to the operating system; `realtime` reports what was granted."""

    policy: Policy
    priority: int
    lock_memory: bool
    cores: tuple[int, ...] = ()  # Where the loop may run; empty: anywhere
    polling_ns: int | None = None
    """Longest time that the clock is polled before a deadline; None: a tenth of the period."""
    reply_polling_ns: int | None = None
    """Longest time that a reply is polled for, 0: never; None: as a tenth of a core allows."""
    idle_latency: bool = False  # Keep the cores from deep idle states


LimitedInterface: TypeAlias = Literal["velocity", "effort", "pwm"]
"""Command interfaces whose magnitude a register of a servo may limit."""


class ServoLimit(msgspec.Struct, frozen=True):
    """A register that limits the goals of a joint's servo, as read at the start or when it returned."""

    interface: LimitedInterface
    value: float  # Highest goal without its sign: rad/s or m/s, the unit of the effort, share of the voltage
    text: str  # The register and its value: `Current Limit (38) = 20, 0.0538 A`


class JointPlan(msgspec.Struct, frozen=True):
    """One joint as the loop and the gate see it; rows of all arrays are in the order of the plan's joints."""

    name: str
    lower: float  # rad, or m of a linear joint; the tighter one of the file's limit and the servo's reach
    upper: float
    velocity: float | None
    """rad/s; the servo's top speed where the file gives none; None: not known either, or a log of the time
    before acceleration limits, which replays without one"""
    effort: float | None = None
    """Nm, A or the fraction of maximum, as the model measures it; None: no limit in the file"""
    continuous: bool = False  # A wheel, or a joint of many turns
    bounded: bool = True
    """`lower` and `upper` bind velocity, effort and PWM too; not those of a continuous joint whose limits the
    file does not give: a wheel turns for ever."""
    top_speed: float | None = None  # The servo's own, rad/s; None: not known
    top_effort: float | None = None
    """The highest goal that the servo has, in the unit of `effort`; None: it has none, or it is not known."""
    acceleration: float | None = None
    """rad/s^2, by which goals may become faster and slower; None: no limit in the file"""
    servo: str = ""  # ID and bus, for sentences
    motor: MotorModel | None = None
    """Its servo's motor, of the motor file that the robot file names; None: it names none"""
    servo_model: ServoModel | None = None  # Its servo by the manual; None: several servos move it

    unit: JointUnit = ROTARY
    """Of its positions; those of its speeds, accelerations and torques follow from it."""
    coupled: tuple[str, ...] = ()
    """The joints that the same servos move, itself among them; empty: none but itself."""
    tolerance: float | None = None
    """Distance within which a goal is reached, rad or m, UNLIMITED: any; None: the default"""
    rest_speed: float | None = None
    """Speed below which the joint is at rest, rad/s or m/s, UNLIMITED: any; None: the default"""
    settle_ns: int = SETTLE_NS
    """How long after the end of a motion its goal may still be reached"""
    wrap: bool = False  # A continuous joint to which a turn more is the same place
    servo_limits: tuple[ServoLimit, ...] = ()
    """Registers of its servos that limit goals; empty in the plan, as they are read at the start."""
    keys: dict[str, object] = {}
    """Keys of features that the file gives it, in SI units; `JointKey.of` returns one with its type."""

    @property
    def label(self) -> str:
        """The joint with its servo, as sentences name it."""
        return f"{self.name} ({self.servo})" if self.servo else self.name

    @property
    def highest_speed(self) -> float:
        """The lowest of the file's limit, the servo's top speed and its registers, rad/s."""
        return self._highest("velocity")

    @property
    def step_speed(self) -> float:
        """The speed to which the steps between goals are held, rad/s.

        Where the file limits the speed, it is sent with each goal, so a register of the servo binds the steps
        too. Without a limit in the file a servo goes to a position as fast as it can.
        """
        speed = _or_inf(self.velocity)
        return min(speed, self.highest_speed) if speed < _or_inf(self.top_speed) else speed

    @property
    def highest_effort(self) -> float:
        """The lowest of the file's limit, the servo's highest goal and its registers; unit as `effort`."""
        return self._highest("effort")

    @property
    def highest_pwm(self) -> float:
        """The full voltage, 1, or less where a register of the servo limits it."""
        return self._highest("pwm")

    @property
    def immovable(self) -> str:
        """Why the joint cannot move to a position: a register of its servo; empty: it can."""
        own = self.find_servo_limit("velocity")
        return "" if own is None or own.value else f"{self.label} cannot move, as its servo has {own.text}"

    def find_servo_limit(self, interface: LimitedInterface) -> ServoLimit | None:
        """Return the register that is tighter than the file and the manual; None where none is."""
        own = next((one for one in self.servo_limits if one.interface == interface), None)
        return None if own is None or own.value >= self._planned_limit(interface) else own

    @property
    def binding_servo_limits(self) -> tuple[ServoLimit, ...]:
        """The registers that are tighter than the file and the manual."""
        return tuple(own for own in self.servo_limits if self.find_servo_limit(own.interface))

    def exceeds_file_limit(self, interface: LimitedInterface) -> bool:
        """Check whether the file's limit allows more than a register of the servo."""
        given = self.velocity != self.top_speed and not self.coupled if interface == "velocity" else True
        limits = {"velocity": self.velocity, "effort": self.effort, "pwm": None}
        return given and limits[interface] is not None and self.find_servo_limit(interface) is not None

    def describe_servo_limit(self, own: ServoLimit) -> str:
        """Return what a register of the servo does to goals, and a remedy where the file allows more."""
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
        """Distance within which a goal of the joint is reached, rad or m."""
        return GOAL_TOLERANCES[self.unit] if self.tolerance is None else self.tolerance

    @property
    def highest_rest_speed(self) -> float:
        """Speed below which the joint counts as at rest, rad/s or m/s."""
        return GOAL_TOLERANCES[self.unit] if self.rest_speed is None else self.rest_speed

    def way(self, begin: float, end: float) -> float:
        """Return the signed way from one position to another, the shorter one of a joint that wraps."""
        return (nearest_turn(end, begin) if self.wrap else end) - begin

    @property
    def slow_speed(self) -> float:
        """How fast its goals move at most in the first second after torque was switched on."""
        return SLOW_SPEEDS[self.unit]

    @property
    def rest(self) -> Mode:
        """The mode into which a joint without a command is brought where it would not hold still."""
        return Mode.VELOCITY if self.continuous else Mode.POSITION


class JointProperty(msgspec.Struct, frozen=True):
    """A property of joints that `dxlrun check` or a running robot shows."""

    name: str  # Key in the JSON of `check`, and heading of its column
    value: Callable[[JointPlan], object]  # In SI units; None: the joint has none
    column: str | None = None
    """`check` shows the number in the unit of positions followed by this, such as `/s`; None: it does not."""
    limit: bool = False
    """A joint has it in its `limits` in the robot file; without it, the number is the servo's own."""
    listed: str = ""  # Field of `JointValues` that has it; empty: none
    text: Callable[[object, JointUnit], str] | None = None
    """Writes a value that is not in a unit of positions or speeds; None: it is."""


JOINT_PROPERTIES: tuple[JointProperty, ...] = (
    JointProperty("unit", lambda joint: joint.unit.si, listed="units"),
    JointProperty(
        "limits", lambda joint: (joint.lower, joint.upper) if joint.bounded else None, listed="limits"
    ),
    JointProperty("highest speed", lambda joint: joint.highest_speed, listed="speeds"),
    JointProperty("velocity", lambda joint: joint.velocity, column="/s", limit=True),
    JointProperty("acceleration", lambda joint: joint.acceleration, column="/s^2"),
)
"""In the order of the columns of `check`, which shows the keys of features after them."""


@dataclass(frozen=True)
class JointValues:
    """Properties of all joints by name, as clients of a running robot get them."""

    units: dict[str, str]
    """Of each joint's positions."""
    effort_units: dict[str, str]
    limits: dict[str, tuple[float, float]]
    """Lowest and highest position of the joints that have limits."""
    speeds: dict[str, float | None]
    """Highest one of each joint; null: without a limit."""
    joint_keys: dict[str, dict[str, object]]
    """Keys of features: the value of each joint that has the key in the robot file, by key and joint."""

    @classmethod
    def collect(cls, joints: Sequence[JointPlan], effort_units: dict[str, str]) -> JointValues:
        """Return the properties of these joints; their units of effort follow from the models of servos."""
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
    """Something that is not a joint and has states or commands: an entry of a feature's section."""

    name: str
    kind: str  # Word for it in sentences: `device`
    states: tuple[str, ...]  # Names of its states: `angular_velocity.x`
    commands: tuple[str, ...] = ()  # Names of what may be commanded, of a device: `led`
    ranges: tuple[tuple[float, float], ...] = ()  # Lowest and highest value of each command, SI units
    label: str = ""  # As sentences name it: `imu (ID 241 on bus main)`
    commandable: bool = False  # Its entry in the file may name commands
    units: dict[str, str] = {}
    """SI unit of each state that has one, by its name; logs of earlier versions have none."""
    command_units: dict[str, str] = {}
    """SI unit of each command that has one, by its name."""


class ControllerPlan(msgspec.Struct, frozen=True):
    """One controller of the robot file."""

    name: str
    type: str
    distribution: str  # Publisher of the plug-in: `name version`
    parameters: str  # JSON that `Parameters` accepts
    joints: tuple[str, ...]
    command: tuple[str, ...]  # Claimed command interfaces
    publishes: tuple[str, ...]
    active: bool
    every: int  # Updated every n-th cycle
    rate: float | None = None  # Updates per second that the file asks for, Hz; None: the loop's
    fallback: str = ""
    """Name of the controller that takes over when this one breaks its contract; empty: none."""
    into: tuple[str, ...] = ()  # Controllers whose references it commands; empty: it commands the servos
    reference: tuple[str, ...] = ()
    """Interfaces that it exports on each of its joints, for controllers that are `into` it."""
    reads: tuple[str, ...] = ()
    """Interfaces that it reads without a claim: `JOINT/position`, `CONTROLLER/JOINT/position`."""
    topics: tuple[str, ...] = ()  # Its own topics: `/arm/state`
    provides: tuple[str, ...] = ()  # States that it provides to others: `orientation.x`
    source_commands: tuple[str, ...] = msgspec.field(default=(), name=SOURCE_COMMANDS)
    """Commands of sources that it claims: `light/led`; logs have the name of the first kind of source."""
    takeovers: tuple[str, ...] = ()  # Controllers that it may let take over
    partial: bool = False  # It goes on with its other joints while some have no torque

    @property
    def commands_servos(self) -> bool:
        """True when its claims are the servos' and not references of other controllers."""
        return bool(self.command) and not self.into

    def split_group(self, joints: Iterable[JointPlan]) -> tuple[str, tuple[str, ...]] | None:
        """Return a joint that it would bring into a mode without the others that the same servos move.

        Those stay in the mode in which they rest, and a servo has one mode. None: there is no such joint.
        """
        if not self.commands_servos:
            return None
        mode = mode_of(self.command)
        for joint in joints:
            others = tuple(name for name in joint.coupled if name not in self.joints)
            if others and joint.name in self.joints and mode is not joint.rest:
                return joint.name, others
        return None

    @property
    def references(self) -> tuple[str, ...]:
        """Names of the reference interfaces that it exports: `arm_pid/shoulder/position`."""
        return tuple(
            f"{self.name}/{joint}/{interface}" for interface in self.reference for joint in self.joints
        )


class ScheduledGoal(msgspec.Struct, frozen=True):
    """The goal of a played motion, for one controller."""

    end_ns: int  # End of the motion since the loop's first deadline; from then on the goal is judged
    positions: tuple[float | None, ...] = ()
    """Goal of each joint of the controller, rad or m, None: it has to be at rest; empty: not even that"""


class ScheduledCommand(msgspec.Struct, frozen=True):
    """A prepared command that the loop hands to a controller at a time."""

    at_ns: int  # Since the loop's first deadline
    controller: str
    kind: str
    data: bytes  # Little-endian float64
    origin: str  # Its source: `three_parts.yaml:7:5`
    request: str = ""  # The command that `data` was prepared from, as JSON
    goal: ScheduledGoal | None = None
    """Begins with this command; the runtime pursues it where the controller takes no such goal."""


class LoopPlan(msgspec.Struct, frozen=True):
    """Everything the loop needs beside hardware."""

    period_ns: int
    scheduler: SchedulerPlan
    joints: tuple[JointPlan, ...]
    controllers: tuple[ControllerPlan, ...]
    commands: tuple[ScheduledCommand, ...]  # Sorted by time
    end_ns: int | None  # Stop by itself at this time since the first deadline; None: run until a stop
    overrun: OverrunPolicy = "skip"
    tolerated_skips: float = TOLERATED_SKIPS  # Share of its periods that a run may skip and still be good
    least_period_ns: int = 0  # The shortest period that the buses allow, by the time budget; 0: not computed
    slowest_period_ns: int = 0  # The longest period in which no Bus Watchdog stops its servos; 0: any
    policies: PolicyPlan = PolicyPlan()
    schedule: ScheduleName = "absolute"
    sources: tuple[SourcePlan, ...] = ()  # Devices, then sensors
    urdf: str | None = None  # The robot's URDF as it was read; None: the robot file names none
    features: tuple[Feature, ...] = FEATURES
    """Features that take part in the run."""
    feature_plans: dict[str, bytes] = {}
    """What a feature compiled for its own part in the run, by its name."""

    @property
    def origins(self) -> frozenset[str]:
        """Origins of the commands of motion files."""
        return frozenset(command.origin for command in self.commands)

    @property
    def references(self) -> tuple[str, ...]:
        """Names of all reference interfaces, in the order of the cycle's record."""
        return tuple(name for controller in self.controllers for name in controller.references)

    @property
    def layout(self) -> CycleLayout:
        """Of the cycles' records."""
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
        """States of devices, sensors and controllers, by name, in the order of the cycle's record."""
        return {one.name: one.states for one in self.sources} | {
            one.name: one.provides for one in self.controllers if one.provides
        }

    @property
    def source_units(self) -> dict[str, str]:
        """SI units of the states that have one: `imu/angular_velocity.x` -> `rad/s`."""
        return {f"{one.name}/{state}": unit for one in self.sources for state, unit in one.units.items()}

    @property
    def command_units(self) -> dict[str, str]:
        """SI units of the commands of sources that have one, by `light/brightness`."""
        return {
            f"{one.name}/{command}": unit
            for one in self.sources
            for command, unit in one.command_units.items()
        }

    @property
    def source_commands(self) -> tuple[str, ...]:
        """Names of all commands of sources, in the order of the cycle's record."""
        return tuple(f"{one.name}/{command}" for one in self.sources for command in one.commands)
