"""Drive gate: goals of the joints that are led by a velocity, an effort or a PWM instead of to a position."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from dxlrun.control.loop_plan import JointPlan
from dxlrun.interfaces import Commands, Floats, States
from dxlrun.mode import Mode
from dxlrun.run.channels.cycle import Clamp

BRAKING_S = 0.1
"""A joint in velocity mode may come nearer to a position limit by as much of the way that is left in this
time, so it comes to rest there; [i] several times what a servo takes to follow (XM430: some 20 ms)."""
FULL_PWM = 1.0
_DRIVEN = (Mode.VELOCITY, Mode.EFFORT, Mode.PWM)

Flag = Callable[[NDArray[np.intp], Clamp], None]
"""Notes what was done to the commands of these rows."""
_Rows = NDArray[np.intp]


class DriveGate:
    """Turns commands of velocity, effort and PWM into goals, by the joints' modes.

    - NaN was not commanded, and infinity is flagged: the goal is 0 then. A joint without a position to hold
      goes nowhere by itself when nobody commands it any more.
    - Velocities are cut to the speed that the gate gives, efforts to `limits.effort`, PWM to full voltage;
      all of them to what the servo has.
    - Within position limits: a velocity that leads outward becomes smaller toward the limit and is 0 there;
      an effort or a PWM that leads outward is 0 from the limit on. Where the position is not known, each of
      them is 0. A wheel (a joint that is not `bounded`) has none of this.
    - In mode EFFORT_POSITION the effort is a limit: its magnitude counts, NaN keeps the last one.
    """

    __slots__ = ("_effort", "_flag", "_free", "_limiting", "_lower", "_rows", "_speed", "_upper", "any")

    def __init__(self, joints: Sequence[JointPlan], flag: Flag) -> None:
        self.any = False
        """True when a joint is in a mode that concerns this gate."""
        self._flag = flag
        self._lower = np.array([joint.lower for joint in joints], dtype=np.float64)
        self._upper = np.array([joint.upper for joint in joints], dtype=np.float64)
        self._effort = np.array([joint.highest_effort for joint in joints])
        self._speed = np.array([joint.highest_speed for joint in joints])
        self._free = np.array([not joint.bounded for joint in joints], dtype=np.bool_)
        none = np.empty(0, dtype=np.intp)
        self._rows: dict[Mode, _Rows] = dict.fromkeys(_DRIVEN, none)
        self._limiting = none

    def take(self, modes: NDArray[np.uint8]) -> None:
        """Learn the joints' modes, shape (joints,)."""
        self._rows = {mode: np.flatnonzero(modes == mode) for mode in _DRIVEN}
        self._limiting = np.flatnonzero(modes == Mode.EFFORT_POSITION)
        self.any = bool(self._limiting.size or any(rows.size for rows in self._rows.values()))

    def apply(self, commands: Commands, goals: Commands, states: States, speed: Floats, dt_ns: int) -> None:
        """Fill the goals of these joints; `speed`, rad/s, is the highest of each joint in this cycle."""
        for mode, wanted, goal, most, clamp in (
            (
                Mode.VELOCITY,
                commands.velocity,
                goals.velocity,
                np.minimum(speed, self._speed),
                Clamp.VELOCITY,
            ),
            (Mode.EFFORT, commands.effort, goals.effort, self._effort, Clamp.EFFORT),
            (Mode.PWM, commands.pwm, goals.pwm, np.full_like(speed, FULL_PWM), Clamp.PWM),
        ):
            rows = self._rows[mode]
            if rows.size:
                values = self._bounded(rows, wanted[rows], most[rows], clamp)
                goal[rows] = self._inward(rows, values, states.position[rows], mode, dt_ns)
        if self._limiting.size:
            self._limit(commands.effort, goals.effort)

    def _bounded(self, rows: _Rows, wanted: Floats, most: Floats, clamp: Clamp) -> Floats:
        """Return finite values of at most this magnitude."""
        self._flag(rows[np.isinf(wanted)], Clamp.NOT_FINITE)
        values = np.where(np.isfinite(wanted), wanted, 0.0)
        beyond = np.abs(values) > most
        if clamp == Clamp.VELOCITY:  # the slow start holds it lower than the file's limit
            slow = beyond & (most < self._speed[rows])
            self._flag(rows[slow], Clamp.STEP)
            beyond &= ~slow
        self._flag(rows[beyond], clamp)
        return np.clip(values, -most, most)

    def _inward(self, rows: _Rows, values: Floats, position: Floats, mode: Mode, dt_ns: int) -> Floats:
        """Return the values without what leads out of the position limits."""
        above, below = self._upper[rows] - position, position - self._lower[rows]  # NaN where not known
        if mode == Mode.VELOCITY:
            seconds = max(BRAKING_S, 2e-9 * dt_ns)  # a slow loop sees late how near it came
            up, down = np.fmax(above, 0.0) / seconds, np.fmax(below, 0.0) / seconds
        else:
            up, down = np.where(above > 0, np.inf, 0.0), np.where(below > 0, np.inf, 0.0)
        up[self._free[rows]] = down[self._free[rows]] = np.inf
        self._flag(rows[(values > up) | (values < -down)], Clamp.OUTWARD)
        return np.minimum(np.maximum(values, -down), up)

    def _limit(self, wanted: Floats, goal: Floats) -> None:
        rows = self._limiting
        values = np.abs(wanted[rows])
        self._flag(rows[np.isinf(values)], Clamp.NOT_FINITE)
        given = np.isfinite(values)
        rows, values = rows[given], values[given]
        most = self._effort[rows]
        self._flag(rows[values > most], Clamp.EFFORT)
        goal[rows] = np.minimum(values, most)
