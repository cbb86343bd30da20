"""Controller: base class of controllers and the types of its interface."""

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
from dxlrun.description.base_form import ParametersModel
from dxlrun.description.joints.servo_model import ServoModel
from dxlrun.errors import ControllerFault
from dxlrun.features.feature import SolvedPose
from dxlsim.motor_model import MotorModel
from dxlwire.joint_unit import JointUnit
from dxlwire.modes import CommandName


class CommandModel(BaseModel):
    """Base class of typed commands: frozen, without unknown keys, with finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)


P = TypeVar("P", bound=ParametersModel)


class Live(msgspec.Struct, frozen=True):
    """Marker of a parameter that may change in a run: `p: Annotated[float, LIVE]`.

    The parameter is a number, a bool, or a mapping from names to numbers or bools, which change separately.
    """


LIVE: Final = Live()


class NotByJoint(msgspec.Struct, frozen=True):
    """Marker of a list whose values do not belong to joints: `Annotated[list[float], NOT_BY_JOINT]`.

    A run that omits joints refuses other lists that are as long as `joints` is: values of the wrong joints
    would move them. A mapping by joint is shortened.
    """


NOT_BY_JOINT: Final = NotByJoint()


class RegisterChange(msgspec.Struct, frozen=True):
    """Value that a controller may write into a register of a joint's servos during a run."""

    joint: str
    item: str
    """Item of the control table, in the RAM."""
    value: int | str
    """Integer on the wire, or a quantity with its unit."""
    at: tuple[str | int, ...] = ()
    """Path in the parameters, to which errors about the register refer."""


class Interfaces(msgspec.Struct, frozen=True):
    """Interfaces that a controller requires and offers, depending on its parameters.

    Attributes:
        joints: Joints that the controller moves.
        command: Command interfaces that are claimed for every joint. No other active controller may claim an
            interface of the same joint. They determine the mode of the joints (`dxlwire.modes.mode_of`):
            `position` alone or with `velocity` (speed toward the position); `velocity`, `effort` or `pwm`
            alone; or `position` with `effort` (effort limit of the servo). If the robot file puts the
            controller `into` others, it claims their reference interfaces of these joints instead.
        reference: Interfaces that are exported for every joint, as `NAME/JOINT/position`. Controllers that
            are `into` this one command them; each has at most one commander.
        reads: Interfaces that are read without a claim, in the order of `Context.reads`: `JOINT/position`,
            `NAME/JOINT/position` (a reference of another controller), `SOURCE/STATE` of a device, a sensor or
            a providing controller, and `SOURCE/age`. States of the controller's own joints need not be
            listed.
        motors: Required figures of `MotorModel`. `resistance`, which is in every motor file, requires any
            motor file; `position_gain` requires one with that figure. A robot without them is refused.
        provides: States that the controller provides, as `NAME/orientation.x`, in the order of
            `Context.provided`. Their readers are updated after it.
        device_commands: Commands of devices that are claimed, `light/led`. No other active controller may
            claim them.
        takeovers: Controllers whose takeover it may request with `Context.take_over`.
        asked_by: Key of the parameters that causes the claim of a command interface, if the claim depends on
            parameters: `{"effort": ("motions", "curl", "steps", 0, "torque")}`. Errors about the interface
            refer to that key.
        partial: True if the controller continues with its other joints after clients have disabled the torque
            of some, and if it may be activated without them. Commands for joints without torque have no
            effect; `states.unable` returns them.
        registers: All values that it passes to `Context.set_registers`, each checked before a run.
        optional: Names in `reads` that the controller can do without. If a run omits their joint, it gets
            the others.
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
    registers: tuple[RegisterChange, ...] = ()
    optional: tuple[str, ...] = ()

    @property
    def source_commands(self) -> tuple[str, ...]:
        """Alias of `device_commands`: commands of devices that the controller claims."""
        return self.device_commands


class JointLimits(msgspec.Struct, frozen=True):
    """Limits of the controller's joints, shape (joints,). Without a limit, positions are infinite and others
    NaN."""

    lower: Floats
    upper: Floats
    velocity: Floats
    effort: Floats
    acceleration: Floats


class RobotModel(msgspec.Struct, frozen=True):
    """Static data of a controller's robot, in the order of the controller's joints."""

    joints: tuple[str, ...]
    servos: tuple[ServoModel | None, ...]
    """Servo of each joint; None: several servos move the joint."""
    motors: tuple[MotorModel | None, ...]
    """Motor of each joint; None: the robot file does not name a motor file."""
    units: tuple[JointUnit, ...]
    """Unit of each joint's position."""
    urdf: str | None
    """Text of the robot's URDF; None: the robot file does not name one."""
    others: tuple[str, ...] = ()
    """All other joints of the robot, without those that the run omits."""
    poses: Mapping[str, SolvedPose] = {}
    """Poses by name."""


class Mismatch(msgspec.Struct, frozen=True):
    """A reason why a robot does not suit a controller, with a fix."""

    what: str
    """Problem, which follows the controller's name in a message: `needs the robot's URDF`."""
    fix: str
    at: str = ""
    """Joint, or key of the controller's entry, such as `payload.link`; empty: the controller itself."""


class SpeedPeak(msgspec.Struct, frozen=True):
    """Highest speed of a joint on the path of a command."""

    joint: str
    speed: float
    """Signed speed, rad/s or m/s."""
    time: float
    """Time of the peak in the time of the command's points, s."""
    where: str
    """Segment of the path: `from point 1 to 2`."""
    at: str = ""
    """Key of the controller that defines the path: `motions.curl`; empty: the command defines it."""


@unique
class Outcome(StrEnum):
    """Outcome of a goal."""

    REACHED = "reached"
    """Every joint replied, had torque, was within its tolerance and at rest."""
    MISSED = "missed"
    """A joint was out of tolerance or still moved after the settling time."""
    ABORTED = "aborted"
    """The controller aborted the goal, was deactivated, or had a fault, or a joint was lost or limp."""
    CANCELLED = "cancelled"
    PREEMPTED = "preempted"
    """Another goal or command replaced it."""


class GoalTolerances(msgspec.Struct, frozen=True):
    """Tolerances of a goal, shape (joints,), in the order of the controller's joints.

    NaN: tolerance of the joint in the robot file, or its default. Infinite: not checked.
    """

    position: Floats
    """Distance from the target, rad or m."""
    velocity: Floats
    """Speed below which a joint is at rest, rad/s or m/s."""
    settle_ns: int | None = None
    """Settling time after the end of the motion; None: the settling times of the joints."""
    left_ns: int | None = None
    """Remaining time until the goal's timeout; None: no timeout."""


class Goal(Protocol):
    """A goal of a controller. The controller pursues one goal at a time until it calls `judge` or `end`."""

    @property
    def number(self) -> int:
        """Number of the goal in this run, from 1."""

    @property
    def kind(self) -> str:
        """Kind of the command that started the goal, a name in `Controller.Goals`."""

    def feedback(self, progress: float, error: float = float("nan")) -> None:
        """Report progress. It may be called in each cycle: the runtime publishes at a lower rate.

        Args:
            progress: 0..1.
            error: Largest distance of a joint from the desired state, rad or m.
        """

    def judge(
        self,
        positions: Floats | None = None,
        *,
        joints: Sequence[str] | None = None,
        tolerances: GoalTolerances | None = None,
        text: str = "",
    ) -> None:
        """Let the runtime decide the outcome. Call it when the goal's motion has ended.

        The goal is reached when all of its joints have replied, have torque, are within their tolerances and
        are at rest. It is aborted if a joint is lost or has no torque, and missed if a joint is still out of
        tolerance after its settling time. Until then the goal runs, and the controller holds its joints.

        Args:
            positions: Requested position of each joint of the controller, before any limit, rad or m. NaN:
                the joint must only be at rest. None: a goal without positions, such as one of efforts, whose
                joints must only reply and have torque.
            joints: Joints that the goal moves; None: all joints of the controller.
            tolerances: Tolerances of this goal; None: those of the joints.
            text: Text for the report of the outcome; empty: the duration of the goal.
        """

    def end(
        self,
        outcome: Outcome,
        text: str = "",
        joint: str = "",
        error: float = float("nan"),
        joints: Sequence[str] | None = None,
    ) -> None:
        """End the goal. Only the first call has an effect.

        For `REACHED`, the runtime decides as in `judge`, with the current position commands of the
        controller. `MISSED` becomes `ABORTED` if a joint is lost or has no torque.

        Args:
            outcome: Outcome.
            text: Text for the report.
            joint: Joint with the largest error; empty: none.
            error: Distance of that joint from its target, rad or m.
            joints: Joints that the goal moves; None: all joints that the controller commands.
        """


class Publish(Protocol):
    """Function that publishes messages on the controller's own topics."""

    def __call__(self, topic: str = "", message: object = None) -> None:
        """Publish a message on `/CONTROLLER/topic` in this cycle.

        Args:
            topic: Topic in `Topics`; empty: mark this cycle for the topics of `publishes`.
            message: Message of the type that `Topics` declares.
        """


def _none() -> Floats:
    return np.zeros(0)


def _take_nothing_over(controllers: Sequence[str], why: str) -> None:
    raise ControllerFault("requested a takeover outside of a run")


def _end_nothing(why: str) -> None:
    raise ControllerFault("requested the end of the run outside of a run")


def _begin_no_goal(kind: str) -> Goal:
    raise ControllerFault("began a goal outside of a run")


def _set_no_registers(values: Mapping[str, Mapping[str, int | str]]) -> None:
    raise ControllerFault("set registers outside of a run")


def _keep_nothing(state: bytes) -> None:
    raise ControllerFault("kept a state without `keeps = True`; set it in the controller's class")


class Context(msgspec.Struct, frozen=True):
    """Data and functions that a controller gets in `on_configure`. Arrays are in the order of its joints.

    The controller writes `commands`; states and goals are read-only. Each cycle overwrites the arrays, so
    copy values that are compared with a later cycle.
    """

    name: str
    joints: tuple[str, ...]
    period_ns: int
    """Nominal period of this controller."""
    limits: JointLimits
    states: States
    """States of the joints, gathered before each update."""
    goals: Commands
    """Goals that were last sent to the servos, gathered before each update and before `on_activate`."""
    commands: Commands
    """Commands, written in `update`; NaN = not commanded yet. Only claimed interfaces are used.

    All are NaN before `on_activate`, and keep their values until the next write. Infinity, or NaN after a
    finite value, is a fault of the controller.
    """
    say: Callable[[str], None]
    """Log a sentence as an event (CONTROLLER_SAYS). Not for use in every cycle."""
    warn: Callable[[str], None]
    """Log a sentence as a warning event. Not for use in every cycle."""
    publish: Publish
    references: Commands
    """Commands of the controllers that are `into` this one, in the order of its joints; NaN = not commanded.

    Only exported interfaces are commanded. The commands are those of this cycle, because upper controllers
    are updated first.
    """
    reads: Floats
    """Values of the interfaces in `Interfaces.reads`, in that order, gathered before each update and before
    `on_activate`; NaN until first known.
    """
    read_names: tuple[str, ...] = ()
    """Names of the interfaces in `reads`."""
    into: tuple[str, ...] = ()
    """Controllers whose references this one commands; empty: it commands the servos."""
    motors: tuple[MotorModel | None, ...] = ()
    """Motors of its joints, from the motor files in the robot file; None: the robot file has none."""
    servos: tuple[ServoModel | None, ...] = ()
    """Data of its joints' servos from the manual; None: several servos move the joint."""
    wrap: tuple[bool, ...] = ()
    """True for a continuous joint that is at the same place after a full turn; goals take the shorter way."""
    units: tuple[JointUnit, ...] = ()
    """Units of the positions of its joints."""
    urdf: str | None = None
    """Text of the robot's URDF; None: the robot file does not name one."""
    provided: Floats = msgspec.field(default_factory=_none)
    """Provided states, shape (provides,), written in `update`; NaN = not known. They are valid in cycles with
    an update if all are finite. If all are NaN, the last states stay published and grow older."""
    source_commands: Floats = msgspec.field(default_factory=_none)
    """Commands of devices and other sources, shape (source_commands,), written in `update`. NaN = not
    commanded: the source keeps its last command."""
    kept: bytes = b""
    """Last state that the controller kept, in this or an earlier run. Empty: none, or it was kept with other
    servos, with other controllers below, or in simulation instead of on servos."""
    keep: Callable[[bytes], None] = _keep_nothing
    """Keep a state for later runs, at most 1 MiB, which replaces the last one. The loop publishes it in
    pieces, one a cycle, and another process writes the file. A newer state replaces a state whose publication
    has not begun."""
    take_over: Callable[[Sequence[str], str], None] = _take_nothing_over
    """Request that controllers of `Interfaces.takeovers` take over, with a reason as text.

    The takeover follows the updates of this cycle. The controllers and the ones below them enter. Controllers
    with conflicting claims leave, and so do the ones above these. Controllers that enter are updated in the
    same cycle, unless their joints must change their modes first. Active ones stay active. An event reports
    the takeover or its refusal."""
    begin_goal: Callable[[str], Goal] = _begin_no_goal
    """Begin a goal of a kind in `Goals` for a motion that the controller starts without a client's command.
    Clients see it and can cancel it. An active goal is preempted."""
    set_registers: Callable[[Mapping[str, Mapping[str, int | str]]], None] = _set_no_registers
    """Set registers of the joints' servos, by joint and item, to values in `Interfaces.registers`.

    They are written in the idle time of the next cycles, also to a servo that returns after a loss or a
    reboot. A register that it set before and that is not named now gets the value from before, and so does
    each one when the controller leaves. Events report what was written."""
    end_run: Callable[[str], None] = _end_nothing
    """Request the end of the run after this cycle by the policy `on_fault`, with a reason as text."""

    @property
    def device_commands(self) -> Floats:
        """Older name of `source_commands`."""
        return self.source_commands


class Controller(ABC, Generic[P]):
    """Base class of controllers, which compute commands from states once a period.

    Life cycle: `on_configure` (before real time: may allocate and do I/O) -> `on_activate` -> `update` ... ->
    `on_deactivate`. All methods except `on_configure` run in the loop: their time must be bounded, without
    I/O, locks or growing allocations. An exception ends the controller, not the process.

    Example:

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
    """Model of the controller's keys in the robot file (except type, active, rate and fallback)."""
    Commands: ClassVar[Mapping[str, type[CommandModel]]] = {}
    """Models of the commands that the controller accepts, by kind."""
    Goals: ClassVar[frozenset[str]] = frozenset()
    """Kinds in `Commands` that are goals: passed to `on_goal`, cancellable, with an outcome."""
    plans: ClassVar[frozenset[str]] = frozenset()
    """Kinds in `Goals` that are planned over several updates before a joint moves. Their clients are answered
    at the first `Goal.feedback` or `Goal.judge`, after 5 s at the latest."""
    Topics: ClassVar[Mapping[str, type]] = {}
    """Message classes of the controller's own topics, by topic name: dataclasses, see dxlrun.tooling.topics.

    A topic with the name of a command has the answers to that command.
    """
    publishes: ClassVar[tuple[str, ...]] = ()
    """Topics of the log that are written in the cycles that it marks: `/joint_states`."""
    keeps: ClassVar[bool] = False
    """True if the controller keeps a state from run to run with `Context.keep`."""
    graceful: ClassVar[bool] = False
    """True if `on_cancel` may complete a motion before it ends the goal. A second cancel then calls it again
    to bring the joints to rest at once; otherwise it is refused."""

    def __init__(self, parameters: P) -> None:
        self.parameters = parameters

    @classmethod
    @abstractmethod
    def interfaces(cls, parameters: P, joints: tuple[str, ...]) -> Interfaces:
        """Return the joints and interfaces that the controller requires and offers.

        Unknown and repeated joints are refused when the robot is compiled. Keys named `joint` or `joints`
        and mappings by joint let a run omit a joint; a controller that still reads it is refused, unless the
        read is `optional`.

        Args:
            parameters: Parameters of the controller.
            joints: All joints of the robot.
        """

    @classmethod
    def mismatches(cls, parameters: P, robot: RobotModel) -> Iterable[Mismatch]:
        """Return mismatches between the robot and these parameters. Any mismatch refuses the robot.

        This must be a pure function. It is called before a run, outside of the loop's process, after joints
        and interfaces were checked.
        """
        return ()

    @classmethod
    def topics(cls, parameters: P) -> Mapping[str, type]:
        """Return message classes of the controller's topics by name.

        Override if they depend on parameters.
        """
        return cls.Topics

    @classmethod
    def motions(cls, parameters: P) -> Mapping[str, float]:
        """Return the duration of each motion that its goal `play` can play, `{"motion": name}`; s by name.

        It is infinite for a motion that is played until it is cancelled.
        """
        return {}

    @classmethod
    def prepare(cls, kind: str, command: CommandModel, parameters: P) -> NDArray[np.float64]:
        """Convert a typed command to a flat array, outside of the loop's process. Must be a pure function.

        The default concatenates the command's fields, each a number or one number a joint.

        Raises:
            ValueError: The command does not fit the parameters; with one sentence.
        """
        if kind not in cls.Commands:
            raise ValueError(f"{cls.__name__} has no command {kind!r}")
        joints = cls.interfaces(parameters, ()).joints
        fields = command.model_dump()
        for what, values in fields.items():
            if isinstance(values, Sized) and len(values) != len(joints):
                raise ValueError(f"{len(values)} {what} for {len(joints)} joints ({', '.join(joints)})")
        return np.hstack([np.asarray(values, dtype=np.float64) for values in fields.values()])

    @classmethod
    def check_command(cls, kind: str, command: CommandModel, parameters: P, robot: RobotModel) -> None:
        """Check a client's command against the robot, such as names of its URDF. Must be a pure function.

        It is called after `prepare`, outside of the loop's process.

        Raises:
            ValueError: The robot cannot execute the command; with one sentence.
        """

    @classmethod
    def speed_peaks(cls, kind: str, data: NDArray[np.float64], parameters: P) -> Iterable[SpeedPeak]:
        """Return the highest speed of each joint on the path of a prepared command. Must be a pure function.

        The runtime compares the speeds with the limits of the joints before a run (motion files) or before it
        accepts a command. Speeds that are fields of the command need not be returned.
        """
        return ()

    def on_configure(self, context: Context) -> None:
        """Prepare for real time, and store `context`."""
        self.context = context

    def on_activate(self, time_ns: int) -> None:
        """Take over the claimed joints at `time_ns`. `context.states` and `context.goals` are current."""

    def on_restart(self, time_ns: int) -> None:
        """Start again from the measured positions, after a joint got torque or was moved in a pause.

        Called instead of `on_activate`, after `on_deactivate` in the same cycle. `context.goals` of these
        joints is the measured position, or 0; goals of other joints are the last ones sent.
        """
        self.on_activate(time_ns)

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Execute a prepared command at the start of a cycle. `data` does not change during the run."""

    def on_goal(self, goal: Goal, data: NDArray[np.float64], time_ns: int) -> None:
        """Start a goal from a prepared command of `goal.kind`. The previous goal was preempted.

        A goal that is aborted here is refused: its client gets the text of `goal.end` as the answer. The same
        applies to a goal of `plans` that is aborted before its client is answered.
        """

    def on_cancel(self, goal: Goal, time_ns: int) -> None:
        """Bring the joints to rest, and call `goal.end` then, in this call or in a later update."""
        goal.end(Outcome.CANCELLED)

    def on_parameters(self, time_ns: int) -> None:
        """React to changed live parameters. `self.parameters` already has all values of the request."""

    def on_hold(self, time_ns: int) -> None:
        """Hold the joints until the next command, after the end of a command stream.

        As in `on_activate`, `context.commands` is NaN, and the gate holds joints whose command stays NaN. A
        controller without this method is updated, but its commands are withheld: positions stay unchanged;
        velocities, efforts and PWM are 0. It is activated again before the next command.
        """

    @abstractmethod
    def update(self, time_ns: int, period_ns: int) -> None:
        """Write `context.commands` from `context.states`.

        While a joint is lost (`states.has_lost`), positions and velocities are held and the lost joint gets
        no commands. Efforts and PWM of the other joints continue.

        Args:
            time_ns: Time of this cycle since the loop started, without pauses.
            period_ns: Measured time since this controller's last update, at most five nominal periods.
        """

    def on_deactivate(self, time_ns: int) -> None:
        """Release the joints. Not called after a fault of the controller."""
