"""sample_player: plays a table of goals, one row a period, and gives up when a joint leaves its bounds.

For measurements: what is commanded is the table and nothing else, whatever the joints answer.
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
from dxlrun_controllers.joints import (
    JointsParameters,
    PerJoint,
    Positive,
    commanded_by,
    finite_or,
    hold,
    row_of,
    take_shorter_way,
)
from dxlrun_controllers.laws.spline import DECELERATION, SplineSample, Stop
from dxlrun_controllers.motions.trajectory_command import Near

_HEAD: Final = 3
"""Numbers in front of the rows of a goal."""
MOST_PIECES: Final = 256
"""Of one table: the `rows` commands before its goal, and the goal's own rows."""


class Bounds(ParametersModel):
    """What ends a goal as aborted; what is left out is not checked."""

    range: dict[str, tuple[Angle, Angle]] = Field(default_factory=dict)
    """Lowest and highest position by joint, rad; rows beyond it are refused."""
    temperature: Annotated[float, Field(gt=0)] | None = None
    """The highest, deg C."""
    effort: PerJoint[Positive] | None = None
    """The highest measured, Nm, A or the fraction of maximum; its magnitude counts."""
    age: Annotated[Duration, Field(gt=0)] | None = None
    """The greatest age of a joint's state."""


class SampleParameters(JointsParameters):
    """Keys of a sample_player in the robot file."""

    command_interface: Literal["position", "posvel", "velocity", "effort", "pwm"] = "position"
    """What the rows command: one number a joint; of posvel the positions, and behind them the speeds."""
    bounds: Bounds = Bounds()

    def mistakes(self) -> Iterator[Mistake]:
        """Yield the ranges whose ends are not in order."""
        yield from super().mistakes()
        for joint, (lower, upper) in self.bounds.range.items():
            if not lower < upper:
                what = f"the range of {joint} ends at {upper:g} rad, where it begins at {lower:g} rad"
                yield ("bounds", "range", joint), f"{what}; write [lower, upper]"

    @property
    def width(self) -> int:
        """How many numbers a row has."""
        return len(self.joints) * (2 if self.command_interface == "posvel" else 1)


Rows = tuple[tuple[float, ...], ...]


class RowsCommand(CommandModel):
    """The first rows of a long table: the next goal plays them, as they were sent in turn, before its own."""

    rows: Rows
    """Shape (rows, joints), of posvel (rows, 2 joints); in the unit of the command interface"""


class SamplesCommand(CommandModel):
    """A goal: play rows, one a period."""

    period: Annotated[float, Field(gt=0, le=3600)]
    """s; the time decides which row is due: a late cycle leaves rows out, it delays none"""
    rows: Rows
    """As of `rows`; they follow those."""
    settle: Annotated[float, Field(ge=0, le=3600)] = 0.0
    """s for which the last row is commanded still, after its period, before the goal is judged"""
    tolerance: Near | None = None
    """rad or m, how near the joints must be to the last row's positions; left out: that of each joint; `inf`:
    the goal is reached when its time is over and its joints have torque"""


@unique
class _Phase(Enum):
    RESTING = auto()
    PLAYING = auto()
    STOPPING = auto()


class SamplePlayer(Controller[SampleParameters]):
    """Plays one table at a time, from the cycle that takes the goal on.

    At its end the joints stay where the last row sends them; velocities decelerate to 0, efforts and PWM
    become 0 at once. The same after a cancel and beyond a bound, but there joints that are commanded by
    position come to rest from where they are and how fast they go.
    """

    Parameters = SampleParameters
    Commands: ClassVar = {"rows": RowsCommand, "samples": SamplesCommand}
    Goals: ClassVar = frozenset({"samples"})

    @classmethod
    def interfaces(cls, parameters: SampleParameters, joints: tuple[str, ...]) -> Interfaces:
        """Claim the command interface of the parameters' joints."""
        return Interfaces(parameters.joints, commanded_by(parameters.command_interface))

    @classmethod
    def prepare(cls, kind: str, command: CommandModel, parameters: SampleParameters) -> NDArray[np.float64]:
        """Return the rows one after the other; of `samples` behind period, settling time and tolerance.

        Raises ValueError for a row of another size, or beyond the range of its joint.
        """
        if not isinstance(command, RowsCommand | SamplesCommand):
            return super().prepare(kind, command, parameters)
        rows = _checked(command.rows, parameters).ravel()
        if isinstance(command, RowsCommand):
            return rows
        tolerance = np.nan if command.tolerance is None else command.tolerance
        return np.concatenate([[command.period, command.settle, tolerance], rows])

    def on_configure(self, context: Context) -> None:
        """Make room for everything that the loop needs."""
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
        self._stop = Stop(count)
        self._deceleration = finite_or(limits.acceleration, DECELERATION)
        self._by_position = self._interface in ("position", "posvel")
        self._rest_lower, self._rest_upper = np.full(count, -np.inf), np.full(count, np.inf)
        if self._by_position:
            self._rest_lower = np.maximum(self._lower, limits.lower)
            self._rest_upper = np.minimum(self._upper, limits.upper)
        self._primary: Floats = getattr(context.commands, commanded_by(self._interface)[0])
        """What a row's first numbers command."""
        self._forget()

    # Life

    def on_activate(self, time_ns: int) -> None:
        """Hold where the joints are; velocities, efforts and PWM begin with 0."""
        self._forget()
        if self._by_position:
            hold(self.context)
        else:
            self._primary.fill(0.0)

    def on_deactivate(self, time_ns: int) -> None:
        """Forget the goal, which the runtime has ended, and rows that wait for one."""
        self._forget()

    def _forget(self) -> None:
        self._phase = _Phase.RESTING
        self._goal: Goal | None = None
        self._pieces: list[Floats] = []
        """The table, piece after piece; those that came before their goal are for the next one."""

    # Commands

    def on_command(self, kind: str, data: NDArray[np.float64], time_ns: int) -> None:
        """Keep rows for the next goal; a table that is played ends."""
        if self._phase is _Phase.PLAYING:
            self._end(Outcome.ABORTED, "rows of another table came")
            self._begin_stop(time_ns)
        self._keep(data)

    def on_goal(self, goal: Goal, data: NDArray[np.float64], time_ns: int) -> None:
        """Play the rows that were kept, and those of the goal."""
        if self._phase is _Phase.PLAYING:  # that one has ended as preempted, its rows with it
            self._pieces = []
        self._keep(data[_HEAD:])
        if len(self._pieces) > MOST_PIECES:
            self._pieces = []
            goal.end(Outcome.ABORTED, f"its table came in more than {MOST_PIECES} pieces")
            self._begin_stop(time_ns)
            return
        self._total = sum(map(len, self._pieces)) // self._width
        self._piece = self._first = 0
        self._goal, self._phase = goal, _Phase.PLAYING
        self._start_ns, self._period_ns = time_ns, float(data[0]) * 1e9
        self._tolerance = float(data[2])
        self._settled_ns = time_ns + round(self._total * self._period_ns + float(data[1]) * 1e9)

    def on_cancel(self, goal: Goal, time_ns: int) -> None:
        """Bring the joints to rest; the goal ends when they are."""
        self._begin_stop(time_ns)

    def _keep(self, rows: Floats) -> None:
        """Keep rows behind the others; one piece too many aborts their goal."""
        if len(self._pieces) <= MOST_PIECES:
            self._pieces.append(rows)

    # In a cycle

    def update(self, time_ns: int, period_ns: int) -> None:
        """Command the row that is due, what brings the joints to rest, or what was commanded last."""
        if self._phase is _Phase.PLAYING:
            self._play(time_ns, period_ns)
        elif self._phase is _Phase.STOPPING:
            self._slow_down(time_ns)

    def _play(self, time_ns: int, period_ns: int) -> None:
        breach = self._breach()
        if breach is not None:
            row, text = breach
            self._end(Outcome.ABORTED, text, row)
            self._begin_stop(time_ns)
            return
        elapsed_ns = time_ns - self._start_ns
        # wake-ups scatter around their deadlines: a row is due half a cycle before its time, at most
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
            self._phase = _Phase.RESTING
            self._end(Outcome.CANCELLED)  # any other end came before the stop

    # The end

    def _breach(self) -> tuple[int, str] | None:
        """Return the first joint that is beyond a bound, and how; None: none is."""
        states, valid = self.context.states, self.context.states.valid
        lower, upper, most, effort = self._lower, self._upper, self._strongest, np.abs(states.effort)
        if not self._by_position and states.has_lost:  # positions are held by the runtime
            return states.unable(range(valid.size))
        if (beyond := ((states.position < lower) | (states.position > self._upper)) & valid).any():
            row = int(beyond.argmax())
            bounds = f"{lower[row]:.4g} to {upper[row]:.4g} rad"
            return row, f"is at {states.position[row]:.4g} rad, outside of its range of {bounds}"
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

    def _end(self, outcome: Outcome, text: str = "", row: int = -1) -> None:
        """End the goal, if there is one; `row` is the joint that is the reason."""
        goal, self._goal = self._goal, None
        if goal is None:
            return
        joint = self.context.joints[row] if row >= 0 else ""
        goal.end(outcome, f"joint {joint} {text}" if joint else text, joint)

    def _hand_over(self) -> None:
        """Let the goal be judged by its last row; efforts and PWM lead to no position and no rest."""
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
        """Let the joints come to rest; `over`: those commanded by position are sent to rest already."""
        if self._phase is _Phase.PLAYING:
            self._pieces = []
        self._phase, self._stop_ns = _Phase.STOPPING, time_ns
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
    """Return rows as an array, shape (rows, width). Raises ValueError for the first that is wrong."""
    width, joints = parameters.width, parameters.joints
    if not rows:
        raise ValueError("there is no row; give at least one")
    for number, row in enumerate(rows, 1):
        if len(row) != width:
            speeds = " and as many speeds" if width > len(joints) else ""
            names = ", ".join(joints)
            raise ValueError(f"{len(row)} numbers in row {number} for {len(joints)} joints ({names}){speeds}")
    table = np.array(rows, dtype=np.float64)
    if parameters.command_interface in ("position", "posvel"):
        for column, joint in enumerate(joints):
            lower, upper = parameters.bounds.range.get(joint, (-np.inf, np.inf))
            beyond = (table[:, column] < lower) | (table[:, column] > upper)
            if beyond.any():
                number = int(beyond.argmax())
                raise ValueError(
                    f"row {number + 1} sends {joint} to {table[number, column]:.4g} rad, outside of its "
                    f"range of {lower:.4g} to {upper:.4g} rad"
                )
    return table
