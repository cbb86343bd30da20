"""Samples: the ticks of a cycle -> states of the whole robot; what cannot be true is no sample."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from math import dist

import numpy as np
from numpy.typing import NDArray

from dxlrun.dynamixel.bus_plan import BusPlan, ServoPlan
from dxlrun.dynamixel.jumps import Jumps
from dxlrun.dynamixel.state_arrays import Arrivals, StateArrays, rows_of
from dxlrun.events import EventSink
from dxlrun.interfaces import Floats, States
from dxlrun.mode import Mode

_WHEEL_MODES = (Mode.VELOCITY, Mode.PWM)


class Samples:
    """Fills the states of all servos at once, one column a servo, in the order of the plans.

    Position: q = direction * (raw * rad_per_tick - reference), rad. The sign of velocity and effort follows
    the joint's direction, so positive effort is torque toward growing q. In wheel mode the speed of a model
    that controls none is a fraction of full output (AX-12A, Present Speed (38)), see `mode_plan`.
    """

    __slots__ = (
        "_age_ns",
        "_all_valid",
        "_arrivals",
        "_here",
        "_jumps",
        "_motion",
        "_never",
        "_now",
        "_now_ns",
        "_position",
        "_reference",
        "_rows",
        "_scale",
        "_speeds",
        "_states",
        "_valid",
        "_values",
        "buses",
    )

    def __init__(self, plans: Sequence[BusPlan], states: States, events: EventSink) -> None:
        servos = [servo for plan in plans for servo in plan.servos]
        self._arrivals = Arrivals.none(len(servos))
        counts = [len(plan.servos) for plan in plans]
        self.buses = tuple(
            StateArrays(plan, self._arrivals.part(end - count, count))
            for plan, count, end in zip(plans, counts, accumulate(counts), strict=True)
        )
        """Where the replies of each bus go."""
        self._jumps = Jumps(plans, events)
        self._states = states
        self._rows = rows_of([servo.row for servo in servos])
        # views of the states; copies where the joints are in another order
        self._motion = states.motion[:, self._rows]
        self._valid = states.valid[self._rows]
        self._age_ns = states.age_ns[self._rows]
        self._all_valid = False  # in the cycle before
        self._values: Floats = np.zeros((3, len(servos)))
        self._position: Floats = self._values[0]
        self._scale: Floats = np.array([_units(servo) for servo in servos]).reshape(-1, 3).T.copy()
        self._reference = np.array([servo.direction * servo.reference for servo in servos])
        self._speeds = _Speeds.of(servos)
        self._here: list[float] = self._motion[0].tolist()  # the positions that the states show
        self._now = np.zeros((), dtype=np.int64)
        self._now_ns = 0
        self._never = True  # nothing ever came of somebody

    def settle(self, now_ns: int, everybody: bool) -> None:
        """Fill the states from the replies of this cycle; `everybody`: that is whose reply arrived.

        The row of a servo of whom nothing came, or nothing that can be true, keeps its values, is invalid,
        and its age grows.
        """
        if self._speeds is not None:
            self._speeds.follow(self._states.mode.tobytes(), self._scale[1])
        values, position, at_ns = self._values, self._position, self._arrivals.at_ns
        np.multiply(self._arrivals.ticks, self._scale, values)
        np.subtract(position, self._reference, position)
        if not everybody:
            self._keep_lost()
        elif not self._all_valid:
            self._all_valid = True
            self._valid.fill(True)
        here: list[float] = position.tolist()
        if not dist(here, self._here) <= self._jumps.surely_none:  # also where one is NaN
            self._sift(here, now_ns)
        self._here = here
        self._motion[...] = values
        self._now[()] = self._now_ns = now_ns  # quicker than to let numpy make an array of an int
        np.subtract(self._now, at_ns, self._age_ns)
        if self._never:
            self._age_ns[at_ns < 0] = -1
            self._never = bool((at_ns < 0).any())
        if not isinstance(self._rows, slice):
            self._hand_over(self._rows)

    def _keep_lost(self) -> None:
        """Let those that are not fresh be invalid and where they were."""
        fresh = self._arrivals.fresh
        self._all_valid = False
        self._valid[:] = fresh
        np.copyto(self._values, self._motion, where=~fresh)

    def _sift(self, here: list[float], now_ns: int) -> None:
        """Let those that jumped be invalid and where they were, as if nothing had come of them."""
        at_ns = self._arrivals.at_ns
        for index in self._jumps.suspects(self._position - self._motion[0], self._valid):
            shown_ns = self._now_ns - int(self._age_ns[index])
            step, elapsed_ns = here[index] - self._here[index], int(at_ns[index]) - shown_ns
            if not self._jumps.can_be(index, step, elapsed_ns, now_ns):
                self._valid[index] = self._all_valid = False
                self._values[:, index] = self._motion[:, index]
                here[index], at_ns[index] = self._here[index], shown_ns

    def _hand_over(self, rows: NDArray[np.intp]) -> None:
        """Fill the states where the joints are in another order than the servos."""
        states = self._states
        states.motion[:, rows] = self._motion
        states.valid[rows] = self._valid
        states.age_ns[rows] = self._age_ns


class _Speeds:
    """The units of present speeds, where any depends on the mode."""

    __slots__ = ("_joint", "_rows", "_seen", "_wheel")

    def __init__(self, rows: Sequence[int], joint: Floats, wheel: Floats) -> None:
        self._rows = rows
        self._joint = joint
        self._wheel = wheel
        self._seen = b""

    @classmethod
    def of(cls, servos: Sequence[ServoPlan]) -> _Speeds | None:
        """Return those of these servos; None where every mode has the same unit."""
        joint = [servo.direction * servo.rad_s_per_tick for servo in servos]
        wheel = [servo.direction * _in_wheel_mode(servo) for servo in servos]
        return (
            None if joint == wheel else cls([servo.row for servo in servos], np.array(joint), np.array(wheel))
        )

    def follow(self, modes: bytes, scale: Floats) -> None:
        """Bring the scale to what the modes of all joints ask for."""
        if modes != self._seen:
            self._seen = modes
            turning = [modes[row] in _WHEEL_MODES for row in self._rows]
            scale[:] = np.where(turning, self._wheel, self._joint)


def _units(servo: ServoPlan) -> tuple[float, float, float]:
    """Return what a tick of position, velocity and effort is, with the joint's sign."""
    units = servo.rad_per_tick, servo.rad_s_per_tick, servo.effort_per_tick
    position, velocity, effort = (servo.direction * unit for unit in units)
    return position, velocity, effort


def _in_wheel_mode(servo: ServoPlan) -> float:
    """Return the unit of the present speed in wheel mode, rad/s."""
    units = [mode.present_rad_s_per_tick for mode in servo.modes if mode.mode == Mode.VELOCITY]
    return units[0] if units else servo.rad_s_per_tick
