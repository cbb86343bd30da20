"""Controller: the contract between dxlrun and the author of a law of motion."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence, Sized
from enum import StrEnum, unique
from typing import ClassVar, Final, Generic, Protocol, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from dxlrun.channels.cycle import Commands, Floats, States
from dxlrun.description.form import ParametersModel
from dxlrun.description.joints.servo import ServoModel
from dxlrun.errors import ControllerFault
from dxlsim.motor_model import MotorModel
from dxlwire.joint_unit import JointUnit
from dxlwire.modes import CommandName


class CommandModel(BaseModel):
    """Base of a typed command: frozen, unknown keys refused, finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)


P = TypeVar("P", bound=ParametersModel)


class Live(msgspec.Struct, frozen=True):
    """Mark of a parameter that may be changed in a run: `p: Annotated[float, LIVE]`; a number or a bool, or a
    mapping of names to them, each of which can be changed."""


LIVE: Final = Live()


class Interfaces(msgspec.Struct, frozen=True):
    """What a controller asks of the robot and offers to other controllers, decided by its parameters.

    `command` interfaces are claimed on every joint of `joints`: no other active controller may have one of
    the same joint. They determine the mode in which the joints are driven (`interfaces.mode_of`): `position`
    alone or with `velocity` (the speed toward it); `velocity`, `effort` or `pwm` alone; or `position` with
    `effort` (the most that the servo may exert). A controller that the robot file puts `into` others claims
    their reference interfaces of these joints instead.

    `reference` interfaces are exported on every joint of `joints`, as `NAME/JOINT/position`: controllers that
    are `into` this one command them, each of them at most one. `reads` are interfaces that it reads without a
    claim, in the order of `Context.reads`: `JOINT/position`, `NAME/JOINT/position` (a reference of another
    controller), `SOURCE/STATE` of a device, a sensor, or a controller that provides it, and `SOURCE/age`. The
    states of its own joints need no such name.

    `provides` are states that it has for others, as `NAME/orientation.x`, in the order of `Context.provided`;
    a controller that reads them is updated after it. `device_commands` are commands of devices, `light/led`,
    that it claims: no other active controller may have one of them. `takeovers` are controllers that it may
    let take over by `Context.take_over`.

    `motors` are figures of `MotorModel` without which it cannot work: `resistance`, which each motor file
    has, stands for any motor file, `position_gain` for one that has that. A robot is refused when one of
    `joints` lacks them.

    `asked_by` names for a command interface the key of the parameters because of which it is claimed, where
    that is not always so: `{"effort": ("motions", "curl", "steps", 0, "torque")}`. A robot that cannot have
    it is refused there.

    `partial`: it goes on with its other joints when clients switch the torque of some off, and it may be
    activated without them. What it commands for those goes nowhere; `states.unable` names them.
    """

    joints: tuple[str, ...]
    command: tuple[CommandName, ...] = ()
    reference: tuple[CommandName, ...] = ()
    reads: tuple[str, ...] = ()
    motors: tuple[str, ...] = ()
    provides: tuple[str, ...] = ()
    device_commands: tuple[str, ...] = ()
    takeovers: tuple[str, ...] = ()
    asked_by: Mapping[CommandName, tuple[str | int, ...]] = msgspec.field(default_factory=dict)
    partial: bool = False

    @property
    def source_commands(self) -> tuple[str, ...]:
        """The same as `device_commands`: commands of devices and other sources."""
        return self.device_commands


class JointLimits(msgspec.Struct, frozen=True):
    """Limits of the controller's joints, shape (joints,): positions are infinite, others NaN where there is
    none."""

    lower: Floats
    upper: Floats
    velocity: Floats
    effort: Floats
    acceleration: Floats


class RobotModel(msgspec.Struct, frozen=True):
    """What is known of a controller's robot before it runs; rows in the order of the controller's joints."""

    joints: tuple[str, ...]
    servos: tuple[ServoModel | None, ...]
    """None: several servos move the joint"""
    motors: tuple[MotorModel | None, ...]
    """None: the robot file names no motor file"""
    units: tuple[JointUnit, ...]
    """Units of positions"""
    urdf: str | None
    """Text of the URDF that the robot file names"""


class Mismatch(msgspec.Struct, frozen=True):
    """Something of the robot that does not fit a controller."""

    what: str
    """Behind the controller's name: `needs the robot's URDF`"""
    fix: str
    at: str = ""
    """A joint, or a key of the controller: `payload.link`; empty: the controller itself"""


class SpeedPeak(msgspec.Struct, frozen=True):
    """The highest speed of a joint on the way that a command describes."""

    joint: str
    speed: float
    """rad/s, of a linear joint m/s, with its sign"""
    time: float
    """s, in the time of the command: that of its points"""
    where: str
    """The part of the way: `from point 1 to 2`"""
    at: str = ""
    """The key of the controller that describes the way: `motions.curl`; empty: the command does"""


@unique
class Outcome(StrEnum):
    """How a goal ended."""

    REACHED = "reached"
    """Every joint answered, had torque, was within tolerance of its goal and at rest."""
    MISSED = "missed"
    """A joint was off, or moved still, after the settling time."""
    ABORTED = "aborted"
    """The controller gave it up, was deactivated, or broke its contract."""
    CANCELLED = "cancelled"
    PREEMPTED = "preempted"
    """Another goal took its place."""


class GoalTolerances(msgspec.Struct, frozen=True):
    """How near the joints of a goal must come, shape (joints,) in the order of the controller's joints.

    NaN: the tolerance of the joint, by the robot file or its default; infinite: not checked.
    """

    position: Floats
    """Distance from the goal, rad or m."""
    velocity: Floats
    """Speed below which a joint is at rest, rad/s or m/s."""
    settle_ns: int | None = None
    """How long after the end of the motion the goal may still be reached, ns; None: the joints' own."""
    left_ns: int | None = None
    """How long the goal may take from now on in any case, ns; None: it has no time-out."""


class Goal(Protocol):
    """A goal that a controller works on, one at a time, until it calls `judge` or `end`."""

    @property
    def number(self) -> int:
        """Its identity in this run, from 1."""

    @property
    def kind(self) -> str:
        """Name of the command that it came with."""

    def feedback(self, progress: float, error: float = float("nan")) -> None:
        """Report progress, 0..1, and the largest distance from the desired state; the runtime thins it."""

    def judge(
        self,
        positions: Floats | None = None,
        *,
        joints: Sequence[str] | None = None,
        tolerances: GoalTolerances | None = None,
        text: str = "",
    ) -> None:
        """Hand the goal over to the runtime: its motion has ended, and the runtime decides how the goal did.

        The goal is reached when each of its joints has answered, has torque, is within tolerance of its
        position and is at rest. It is aborted when a joint is lost or has no torque, and missed when a joint
        is still off after its settling time. Until then the goal runs, and the controller holds its joints.

        Args:
            positions: Goal of each joint of the controller as it was asked, before any limit, rad or m; NaN:
                the joint has only to be at rest. None: the goal has no positions, such as one of efforts; its
                joints have only to answer and to have torque.
            joints: Joints that the goal moves; None: all joints of the controller.
            tolerances: Tolerances of this goal; None: those of the joints.
            text: What the report of the result adds; empty: the time that the goal took.
        """

    def end(
        self,
        outcome: Outcome,
        text: str = "",
        joint: str = "",
        error: float = float("nan"),
        joints: Sequence[str] | None = None,
    ) -> None:
        """Report the result, once; `joint` is the worst one, `error` its distance from the goal, SI units.

        `joints` are those that the goal moves, None: all that the controller commands. Reached is judged as
        by `judge`, with the positions that the controller commands now. A goal is aborted instead of missed
        when one of its joints is lost or has no torque.
        """


class Publish(Protocol):
    """Publishes a message on one of the controller's own topics."""

    def __call__(self, topic: str = "", message: object = None) -> None:
        """Publish `message`, of the type declared in `Topics`, as `/CONTROLLER/topic`, at this cycle.

        Without a topic: mark this cycle for the topics of `publishes`.
        """


def _none() -> Floats:
    return np.zeros(0)


def _take_nothing_over(controllers: Sequence[str], why: str) -> None:
    raise ControllerFault("requested a takeover outside of a run")


def _end_nothing(why: str) -> None:
    raise ControllerFault("requested the end of what is no run")


def _keep_nothing(state: bytes) -> None:
    raise ControllerFault("kept a state, but is not declared to: set `keeps = True` in its class")


class Context(msgspec.Struct, frozen=True):
    """What a controller gets when it is configured; the arrays are in the order of its joints.

    `commands` is its own; states and goals are to be read only, and a copy must be made of what is to be
    compared with a later cycle.
    """

    name: str
    joints: tuple[str, ...]
    period_ns: int
    """The nominal period of this controller, ns."""
    limits: JointLimits
    states: States
    """Gathered by the manager before each update."""
    goals: Commands
    """What was last sent to the servos, gathered before each update and before on_activate."""
    commands: Commands
    """To be written by update; the manager takes only the claimed interfaces, NaN = not yet commanded.

    All NaN before on_activate; what is not written keeps its value. A joint's interface that was once finite
    and is NaN again, or is ever infinite, is the controller's fault.
    """
    say: Callable[[str], None]
    """Leave a sentence in the log (event CONTROLLER_SAYS); for rare things."""
    warn: Callable[[str], None]
    """The same, as a warning."""
    publish: Publish
    references: Commands
    """What the controllers that are `into` this one command, in the order of its joints; NaN = not commanded.

    Only the exported interfaces are ever commanded. As fresh as this cycle: those above are updated before.
    """
    reads: Floats
    """Values of `Interfaces.reads`, shape (reads,), gathered before each update and before on_activate; NaN
    where there is none yet."""
    read_names: tuple[str, ...] = ()
    """What they are values of."""
    into: tuple[str, ...] = ()
    """Controllers whose references this one commands; empty: it commands the servos."""
    motors: tuple[MotorModel | None, ...] = ()
    """The motors of its joints' servos, by the motor files that the robot file names; None: it names none."""
    servos: tuple[ServoModel | None, ...] = ()
    """Its joints' servos, by the manual; None: several servos move the joint."""
    wrap: tuple[bool, ...] = ()
    """True: a continuous joint to which a turn more is the same place; goals take the shorter way"""
    units: tuple[JointUnit, ...] = ()
    """Units of the positions of its joints."""
    urdf: str | None = None
    """Text of the URDF that the robot file names; None: it names none."""
    provided: Floats = msgspec.field(default_factory=_none)
    """What it provides, shape (provides,), to be written by update; NaN = not known. Valid in the cycles in
    which it is updated and all of them are finite; all NaN: nothing new, what is shown grows older."""
    device_commands: Floats = msgspec.field(default_factory=_none)
    """Its commands of devices and other sources, shape (device_commands,), to be written by update, NaN = not
    commanded: the source keeps what it has."""
    kept: bytes = b""
    """What the controller kept last, in this run or an earlier one; empty where there is nothing, or where it
    was made with other servos, with other controllers below, or in simulation instead of on servos."""
    keep: Callable[[bytes], None] = _keep_nothing
    """Keep a state for later runs, 1 MiB at most, in place of the one before. It leaves the loop in pieces,
    one a cycle, and another process writes the file; one that has not begun to leave is replaced by a newer
    one."""
    take_over: Callable[[Sequence[str], str], None] = _take_nothing_over
    """Request that controllers of `Interfaces.takeovers` take over, with those below them, and why, in words.

    Done behind the updates of this cycle: those that claim what they claim leave, with those above them;
    those that enter are updated in the same cycle, unless their joints must change their modes first. What
    is active already stays as it is. An event says what was done, or why it was refused."""
    end_run: Callable[[str], None] = _end_nothing
    """Request that the run ends behind this cycle, by the policy `on_fault`, and why, in words."""

    @property
    def source_commands(self) -> Floats:
        """The same as `device_commands`: devices were the first sources with commands."""
        return self.device_commands


class Controller(ABC, Generic[P]):
    """A law of motion: states in, commands out, once a period.

    Life: `on_configure` (before real time: may allocate and do I/O) -> `on_activate` -> `update` ... ->
    `on_deactivate`. All but `on_configure` are in the loop: bounded, no I/O, no lock,
    no growing allocation. What they raise ends the controller, not the process. A whole one:

        class Wave(Controller[ParametersModel]):
            @classmethod
            def interfaces(cls, parameters, joints):
                return Interfaces(joints, ("position",))

            def on_activate(self, time_ns):
                self.begin_ns, self.middle = time_ns, self.context.goals.position.copy()

            def update(self, time_ns, period_ns):
                swing = 0.2 * math.sin(time_ns / 1e9 - self.begin_ns / 1e9)
                np.add(self.middle, swing, out=self.context.commands.position)
    """

    Parameters: ClassVar[type[ParametersModel]] = ParametersModel
    """The model of the controller's keys in the robot file (all but type, active, rate and fallback)."""
    Commands: ClassVar[Mapping[str, type[CommandModel]]] = {}
    """The typed commands it takes, by name."""
    Goals: ClassVar[frozenset[str]] = frozenset()
    """Names of those commands that are goals: they come to `on_goal`, can be cancelled, and have a result."""
    Topics: ClassVar[Mapping[str, type]] = {}
    """Its own topics, by name, with the type of their messages: a dataclass, see dxlrun.messages."""
    publishes: ClassVar[tuple[str, ...]] = ()
    """Topics of the log that are written in the cycles it marks: `/joint_states`."""
    keeps: ClassVar[bool] = False
    """It calls `Context.keep`."""

    def __init__(self, parameters: P) -> None:
        self.parameters = parameters

    @classmethod
    @abstractmethod
    def interfaces(cls, parameters: P, joints: tuple[str, ...]) -> Interfaces:
        """Return the joints and command interfaces that it needs; `joints` are all joints of the robot.

        Joints that the robot does not have, and joints named twice, are refused when the robot is compiled.
        """

    @classmethod
    def mismatches(cls, parameters: P, robot: RobotModel) -> Iterable[Mismatch]:
        """Return what of the robot does not fit these parameters, so that it is refused; a pure function.

        Before a run and outside of the loop's process, once joints and interfaces are known to be right.
        """
        return ()

    @classmethod
    def topics(cls, parameters: P) -> Mapping[str, type]:
        """Return its own topics: `Topics`, unless the parameters decide which they are."""
        return cls.Topics

    @classmethod
    def motions(cls, parameters: P) -> Mapping[str, float]:
        """Return the motions that its goal `play` plays, `{"motion": name}`, and how long each is, s."""
        return {}

    @classmethod
    def prepare(cls, kind: str, command: CommandModel, parameters: P) -> NDArray[np.float64]:
        """Turn a typed command into one flat array, outside the loop's process; a pure function.

        Without one of its own: the command's fields one after the other, each a number or one number a joint.
        Raises ValueError with one sentence when the command does not fit the parameters.
        """
        if kind not in cls.Commands:
            raise ValueError(f"{cls.__name__} takes no command {kind!r}")
        joints = cls.interfaces(parameters, ()).joints
        fields = command.model_dump()
        for what, values in fields.items():
            if isinstance(values, Sized) and len(values) != len(joints):
                raise ValueError(f"{len(values)} {what} for {len(joints)} joints ({', '.join(joints)})")
        return np.hstack([np.asarray(values, dtype=np.float64) for values in fields.values()])

    @classmethod
    def speed_peaks(cls, kind: str, data: NDArray[np.float64], parameters: P) -> Iterable[SpeedPeak]:
        """Return the highest speed of each joint on the way of a prepared command; a pure function.

        The runtime compares them with the limits of the joints: in a file before a run, in a command before
        it is taken. Values that are fields of the command need no peak.
        """
        return ()

    def on_configure(self, context: Context) -> None:
        """Prepare for real time; keep `context`."""
        self.context = context

    def on_activate(self, time_ns: int) -> None:
        """Take over the claimed joints; `context.states` and `context.goals` are fresh."""

    def on_restart(self, time_ns: int) -> None:
        """Begin again where the joints are: one of them was given torque, or was moved in a pause.

        Called in place of `on_activate`, after `on_deactivate` in the same cycle. `context.goals` of such a
        joint are where it is, or 0; those of the others are what was last sent.
        """
        self.on_activate(time_ns)

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Take a prepared command at the start of a cycle; `data` stays as it is until the run ends."""

    def on_goal(self, goal: Goal, data: NDArray[np.float64], time_ns: int) -> None:
        """Take a prepared command that is a goal (`goal.kind`); the one before has ended as preempted."""

    def on_cancel(self, goal: Goal, time_ns: int) -> None:
        """Bring the joints to rest; call `goal.end` when they are, in this call or in a later update."""
        goal.end(Outcome.CANCELLED)

    def on_parameters(self, time_ns: int) -> None:
        """Take changed live parameters: `self.parameters` has them already, all of one request together."""

    def on_hold(self, time_ns: int) -> None:
        """Hold the joints by commands until the next command: the stream of commands ended.

        Called as `on_activate` is: `context.commands` is NaN, and a joint whose command stays NaN is held by
        the gate. A controller without this method is updated, but its commands are withheld: positions stay,
        velocities, efforts and PWM are 0. Before the next command it is activated again.
        """

    @abstractmethod
    def update(self, time_ns: int, period_ns: int) -> None:
        """Write `context.commands` from `context.states`.

        `time_ns`: time of this cycle since the loop started. `period_ns`: since this controller's last
        update, the true one, capped. While a joint is lost (`states.has_lost`) positions and velocities are
        held, and nothing is commanded to that joint; efforts and PWM of the others continue.
        """

    def on_deactivate(self, time_ns: int) -> None:
        """Let go of the joints; not called for a controller that was ended by a fault."""
