"""sample_player: play a table of goals, one row per period, and abort when a joint leaves its bounds.

It is meant for measurements: the commands are exactly the rows of the table, without any feedback.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum, auto, unique
from typing import Annotated, ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from dxlrun import (
    Angle,
    CommandModel,
    Context,
    Controller,
    Duration,
    Floats,
    Goal,
    GoalTolerances,
    Interfaces,
    Mistake,
    Outcome,
    ParametersModel,
)
from dxlrun_controllers.joint_parameters import (
    JointsParameters,
    PerJoint,
    Positive,
    commanded_by,
    finite_or,
    hold_joints,
    row_of,
    take_shorter_way,
)
from dxlrun_controllers.laws.spline import DECELERATION, SplineSample, StopTrajectory
from dxlrun_controllers.motions.trajectory_command import Near

_HEAD: Final = 3
"""Number of values before the rows of a prepared goal: period, settling time and tolerance."""
MOST_PIECES: Final = 256
"""Upper limit of the pieces of a table: `rows` commands before its goal, and the goal's own rows."""


class Bounds(ParametersModel):
    """Bounds whose violation aborts a goal. A bound that is not given is not checked."""

    range: dict[str, tuple[Angle, Angle]] = Field(default_factory=dict)
    """Lowest and highest position by joint, rad. Rows beyond it are rejected."""
    temperature: Annotated[float, Field(gt=0)] | None = None
    """Highest temperature, deg C."""
    effort: PerJoint[Positive] | None = None
    """Highest magnitude of the measured effort, Nm, A or the fraction of maximum."""
    age: Annotated[Duration, Field(gt=0)] | None = None
    """Largest age of a joint's state."""


class SampleParameters(JointsParameters):
    """Keys of a sample_player in the robot file."""

    command_interface: Literal["position", "posvel", "velocity", "effort", "pwm"] = "position"
    """Interface of the rows. A row has one number per joint; with posvel, the speeds follow the positions."""
    bounds: Bounds = Bounds()

    def mistakes(self) -> Iterator[Mistake]:
        """Yield the ranges of `bounds` whose lower end is not below the upper end."""
        yield from super().mistakes()
        for joint, (lower, upper) in self.bounds.range.items():
            if not lower < upper:
                what = f"the range of {joint} from {lower:g} rad to {upper:g} rad is empty"
                yield ("bounds", "range", joint), f"{what}; write [lower, upper]"

    @property
    def width(self) -> int:
        """Number of values in a row of the table."""
        return len(self.joints) * (2 if self.command_interface == "posvel" else 1)


Rows = tuple[tuple[float, ...], ...]


class RowsCommand(CommandModel):
    """First rows of a long table. The next goal plays them before its own rows, in the order of sending."""

    rows: Rows
    """Shape (rows, joints), or (rows, 2 joints) with posvel; in the unit of the command interface"""


class SamplesCommand(CommandModel):
    """Goal of a sample_player: rows that are played, one per period."""

    period: Annotated[float, Field(gt=0, le=3600)]
    """Time of a row, s. Late cycles skip rows, and do not delay those that follow."""
    rows: Rows
    """Rows that follow those of the `rows` commands, in the same format"""
    settle: Annotated[float, Field(ge=0, le=3600)] = 0.0
    """Time for which the last row is commanded after its period, before the goal is judged, s"""
    tolerance: Near | None = None
    """Position tolerance at the last row, rad or m; by default each joint's own. With `inf`, the goal is
    reached when its time is over and its joints have torque."""


@unique
class _PlayerPhase(Enum):
    RESTING = auto()
    PLAYING = auto()
    STOPPING = auto()


class SamplePlayer(Controller[SampleParameters]):
    """Controller that plays one table at a time, starting in the cycle that accepts the goal.

    After the end, position-controlled joints hold the last row, velocities decelerate to 0, and efforts and
    PWM become 0 at once. A cancel or a violated bound has the same effect, except that position-controlled
    joints decelerate from their measured position and velocity.
    """

    Parameters = SampleParameters
    Commands: ClassVar = {"rows": RowsCommand, "samples": SamplesCommand}
    Goals: ClassVar = frozenset({"samples"})

    @classmethod
    def interfaces(cls, parameters: SampleParameters, joints: tuple[str, ...]) -> Interfaces:
        """Claim the command interface of the joints."""
        return Interfaces(parameters.joints, commanded_by(parameters.command_interface))

    @classmethod
    def prepare(cls, kind: str, command: CommandModel, parameters: SampleParameters) -> NDArray[np.float64]:
        """Return the rows of a command as a flat array; `samples` has period, settling time and tolerance
        before them.

        Raises:
            ValueError: A row has the wrong size, or exceeds the range of a joint.
        """
        if not isinstance(command, RowsCommand | SamplesCommand):
            return super().prepare(kind, command, parameters)
        rows = _checked(command.rows, parameters).ravel()
        if isinstance(command, RowsCommand):
            return rows
        tolerance = np.nan if command.tolerance is None else command.tolerance
        return np.concatenate([[command.period, command.settle, tolerance], rows])

    def on_configure(self, context: Context) -> None:
        """Allocate all memory that the loop needs."""
        super().on_configure(context)
        count, bounds, limits = len(context.joints), self.parameters.bounds, context.limits
        self._interface = self.parameters.command_interface
        self._width = self.parameters.width
        ranges = [bounds.range.get(joint, (-np.inf, np.inf)) for joint in context.joints]
        self._lower, self._upper = np.array(ranges).T
        self._hottest = np.inf if bounds.temperature is None else bounds.temperature
        self._strongest = row_of(bounds.effort, context.joints)
        self._oldest_ns = np.int64(np.iinfo(np.int64).max if bounds.age is None else bounds.age)
        self._wrap = np.array(context.wrap)
        self._still = SplineSample(count)
        self._stop = StopTrajectory(count)
        self._deceleration = finite_or(limits.acceleration, DECELERATION)
        self._by_position = self._interface in ("position", "posvel")
        self._rest_lower, self._rest_upper = np.full(count, -np.inf), np.full(count, np.inf)
        if self._by_position:
            self._rest_lower = np.maximum(self._lower, limits.lower)
            self._rest_upper = np.minimum(self._upper, limits.upper)
        self._primary: Floats = getattr(context.commands, commanded_by(self._interface)[0])
        """Command array for the first values of a row."""
        self._forget()

    # Life

    def on_activate(self, time_ns: int) -> None:
        """Discard all rows, and hold the joints; velocities, efforts and PWM start at 0."""
        self._forget()
        if self._by_position:
            hold_joints(self.context)
        else:
            self._primary.fill(0.0)

    def on_deactivate(self, time_ns: int) -> None:
        """Drop the goal, which the runtime has ended, and all rows."""
        self._forget()

    def _forget(self) -> None:
        self._phase = _PlayerPhase.RESTING
        self._goal: Goal | None = None
        self._pieces: list[Floats] = []
        """Pieces of the table, each a flat array of rows.

        Those received without a goal are for the next goal.
        """

    # Commands

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Store rows for the next goal. A table that is being played is aborted."""
        if self._phase is _PlayerPhase.PLAYING:
            self._end_goal(Outcome.ABORTED, "rows of another table came")
            self._begin_stop(time_ns)
        self._keep(data)

    def on_goal(self, goal: Goal, data: NDArray[np.float64], time_ns: int) -> None:
        """Play the stored rows followed by those of the goal."""
        if self._phase is _PlayerPhase.PLAYING:  # drop the rows of the goal that was preempted
            self._pieces = []
        self._keep(data[_HEAD:])
        if len(self._pieces) > MOST_PIECES:
            self._pieces = []
            goal.end(Outcome.ABORTED, f"its table has more than {MOST_PIECES} pieces")
            self._begin_stop(time_ns)
            return
        self._total = sum(map(len, self._pieces)) // self._width
        self._piece = self._first = 0
        self._goal, self._phase = goal, _PlayerPhase.PLAYING
        self._start_ns, self._period_ns = time_ns, float(data[0]) * 1e9
        self._tolerance = float(data[2])
        self._settled_ns = time_ns + round(self._total * self._period_ns + float(data[1]) * 1e9)

    def on_cancel(self, goal: Goal, time_ns: int) -> None:
        """Stop the joints. The goal ends when they are at rest."""
        self._begin_stop(time_ns)

    def _keep(self, rows: Floats) -> None:
        """Store a piece of a table.

        At most one piece too many is stored, so that `on_goal` can abort the goal.
        """
        if len(self._pieces) <= MOST_PIECES:
            self._pieces.append(rows)

    # In a cycle

    def update(self, time_ns: int, period_ns: int) -> None:
        """Command the row of this cycle, or the stop; at rest, the last command stays."""
        if self._phase is _PlayerPhase.PLAYING:
            self._play(time_ns, period_ns)
        elif self._phase is _PlayerPhase.STOPPING:
            self._slow_down(time_ns)

    def _play(self, time_ns: int, period_ns: int) -> None:
        breach = self._breach()
        if breach is not None:
            row, text = breach
            self._end_goal(Outcome.ABORTED, text, row)
            self._begin_stop(time_ns)
            return
        elapsed_ns = time_ns - self._start_ns
        # Wake-ups have jitter, so a row counts as due up to half a cycle before its time.
        early_ns = min(self._period_ns, period_ns) / 2
        if time_ns + early_ns >= self._settled_ns:
            self._hand_over()
            self._begin_stop(time_ns, over=True)
            return
        index = min(int((elapsed_ns + early_ns) / self._period_ns), self._total - 1)
        piece = self._pieces[self._piece]
        while index >= self._first + len(piece) // self._width:
            self._first += len(piece) // self._width
            self._piece += 1
            piece = self._pieces[self._piece]
        at = (index - self._first) * self._width
        joints = len(self._primary)
        values = piece[at : at + joints]
        if self._by_position:
            values = take_shorter_way(values, self._primary, self._wrap)
        np.copyto(self._primary, values)
        if self._width > joints:
            np.copyto(self.context.commands.velocity, piece[at + joints : at + self._width])
        if self._goal is not None:
            self._goal.feedback(min(1.0, elapsed_ns / max(1, self._settled_ns - self._start_ns)))

    def _slow_down(self, time_ns: int) -> None:
        elapsed = (time_ns - self._stop_ns) * 1e-9
        self._stop.sample(elapsed, self._still)
        np.copyto(
            self._primary, self._still.velocity if self._interface == "velocity" else self._still.position
        )
        if elapsed >= self._stop.duration_s:
            self._phase = _PlayerPhase.RESTING
            self._end_goal(Outcome.CANCELLED)  # other outcomes end the goal before the stop

    # The end

    def _breach(self) -> tuple[int, str] | None:
        """Return index and description of the first joint that violates a bound; None while all are
        within.
        """
        states, valid = self.context.states, self.context.states.valid
        lower, upper, most, effort = self._lower, self._upper, self._strongest, np.abs(states.effort)
        # The runtime holds positions while a joint is lost, but not the other interfaces.
        if not self._by_position and states.has_lost:
            return states.unable(range(valid.size))
        if (beyond := ((states.position < lower) | (states.position > self._upper)) & valid).any():
            row = int(beyond.argmax())
            bounds = f"{lower[row]:.4g} to {upper[row]:.4g} rad"
            return row, f"is at {states.position[row]:.4g} rad, outside its range of {bounds}"
        if (beyond := states.temperature > self._hottest).any():
            row = int(beyond.argmax())
            return row, f"has {states.temperature[row]:g} deg C, more than {self._hottest:g}"
        if (beyond := (effort > most) & valid).any():
            row = int(beyond.argmax())
            return row, f"exerts {effort[row]:.4g}, more than {most[row]:.4g}"
        if (beyond := states.age_ns > self._oldest_ns).any():
            row = int(beyond.argmax())
            return row, f"has not answered for {states.age_ns[row] * 1e-6:.0f} ms"
        return None

    def _end_goal(self, outcome: Outcome, text: str = "", row: int = -1) -> None:
        """End the goal, if there is one; the joint with the index `row`, if not -1, is named as the
        reason.
        """
        goal, self._goal = self._goal, None
        if goal is None:
            return
        joint = self.context.joints[row] if row >= 0 else ""
        goal.end(outcome, f"joint {joint} {text}" if joint else text, joint)

    def _hand_over(self) -> None:
        """Pass the goal to the runtime, which judges it by the table's last row.

        Efforts and PWM are not judged by position or rest, because they define neither.
        """
        goal, self._goal = self._goal, None
        if goal is None:
            return
        count, positions = len(self._primary), None
        if np.isfinite(self._tolerance) or np.isnan(self._tolerance):
            if self._by_position:
                positions = self._pieces[-1][-self._width :][:count]
            elif self._interface == "velocity":
                positions = np.full(count, np.nan)
        goal.judge(
            positions,
            tolerances=GoalTolerances(np.full(count, self._tolerance), np.full(count, np.nan)),
        )

    def _begin_stop(self, time_ns: int, *, over: bool = False) -> None:
        """Start to stop the joints; `over`: the table is complete, so positions are at rest already."""
        if self._phase is _PlayerPhase.PLAYING:
            self._pieces = []
        self._phase, self._stop_ns = _PlayerPhase.STOPPING, time_ns
        still, states, goals = self._still, self.context.states, self.context.goals
        still.rows.fill(0.0)
        if self._interface == "velocity":
            np.copyto(still.velocity, goals.velocity, where=np.isfinite(goals.velocity))
        elif self._by_position:
            np.copyto(still.position, self._primary)
            if not over:
                np.copyto(still.position, states.position, where=states.valid)
                np.copyto(still.velocity, states.velocity, where=states.valid)
        self._stop.load(still, self._deceleration, self._rest_lower, self._rest_upper)
        self._slow_down(time_ns)


def _checked(rows: Rows, parameters: SampleParameters) -> Floats:
    """Return the rows of a command as an array, shape (rows, width); raises ValueError for an invalid row."""
    width, joints = parameters.width, parameters.joints
    if not rows:
        raise ValueError("the table has no rows; give at least one")
    for number, row in enumerate(rows, 1):
        if len(row) != width:
            speeds = ", and as many speeds" if width > len(joints) else ""
            names = ", ".join(joints)
            raise ValueError(
                f"row {number} has {len(row)} numbers; give one for each of {len(joints)} joints "
                f"({names}){speeds}"
            )
    table = np.array(rows, dtype=np.float64)
    if parameters.command_interface in ("position", "posvel"):
        for column, joint in enumerate(joints):
            lower, upper = parameters.bounds.range.get(joint, (-np.inf, np.inf))
            beyond = (table[:, column] < lower) | (table[:, column] > upper)
            if beyond.any():
                number = int(beyond.argmax())
                raise ValueError(
                    f"row {number + 1} moves {joint} to {table[number, column]:.4g} rad, outside its "
                    f"range of {lower:.4g} to {upper:.4g} rad"
                )
    return table
