"""Samples: replies of a cycle -> states of the whole robot in SI units; implausible jumps are no samples."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import numpy as np

from dxlrun.dynamixel.exchange.jumps import Jumps
from dxlrun.dynamixel.plan.bus_plan import BusPlan, Field, ServoPlan
from dxlrun.interfaces import Floats, States
from dxlrun.mode import Mode
from dxlrun.run.channels.events import EventSink

_WHEEL_MODES = (Mode.VELOCITY, Mode.PWM)
_CLOCKWISE = 0x400
"""Sign of sign-magnitude items, bit 10 (e-Manual AX-12A, Present Speed (38), Present Load (40))."""


class Samples:
    """Fills the states of all servos at once; arrays have one column a servo, in the order of the plans.

    Position: q = direction * (raw * rad_per_tick - reference), rad. The sign of velocity and effort follows
    the joint's direction, so positive effort is torque toward growing q. In wheel mode the speed of a model
    that controls none is a fraction of full output (AX-12A, Present Speed (38)), see `mode_plan`.
    """

    __slots__ = (
        "_joint_speed",
        "_modes_seen",
        "_states",
        "_wheel_speed",
        "at_ns",
        "buses",
        "fresh",
        "jumps",
        "reference",
        "rows",
        "scale",
        "shown_ns",
        "values",
    )

    def __init__(self, plans: Sequence[BusPlan], states: States, events: EventSink) -> None:
        servos = [servo for plan in plans for servo in plan.servos]
        self._states = states
        self.rows = np.array([servo.row for servo in servos], dtype=np.intp)
        """Row of each servo's joint in the states."""
        self.values: Floats = np.full((3, len(servos)), np.nan)
        """Position, velocity and effort of each servo by its newest intact reply, SI units."""
        self.scale: Floats = np.array([_units(servo) for servo in servos]).reshape(-1, 3).T.copy()
        """Units of a tick of each value; that of the velocity follows the servo's mode."""
        self.reference: Floats = np.array([servo.direction * servo.reference for servo in servos])
        """rad, subtracted from each position."""
        self.fresh = np.zeros(len(servos), dtype=np.bool_)
        """True where an intact reply arrived in this cycle."""
        self.at_ns = np.full(len(servos), -1, dtype=np.int64)
        """Time at which the newest plausible reply arrived; -1 while none ever did."""
        self.shown_ns = self.at_ns.copy()
        """The same as of the end of the cycle before: the time of the sample that the states show."""
        self.jumps = Jumps(plans, events)
        self._joint_speed = self.scale[1].copy()
        self._wheel_speed = np.array([servo.direction * _in_wheel_mode(servo) for servo in servos])
        self._modes_seen = b""
        counts = [len(plan.servos) for plan in plans]
        self.buses = tuple(
            BusSamples(plan, self, end - count)
            for plan, count, end in zip(plans, counts, accumulate(counts), strict=True)
        )
        """Where the replies of each bus go."""

    def follow_modes(self) -> None:
        """Use the unit of velocity that belongs to each servo's mode; before replies are taken."""
        modes = self._states.mode.tobytes()
        if modes != self._modes_seen:
            self._modes_seen = modes
            turning = np.isin(self._states.mode[self.rows], _WHEEL_MODES)
            self.scale[1] = np.where(turning, self._wheel_speed, self._joint_speed)

    def settle(self, now_ns: int) -> None:
        """Fill the states from the replies of this cycle.

        The row of a servo without a reply, or with an implausible one, keeps its values, is invalid, and its
        age grows.
        """
        states, rows, at_ns = self._states, self.rows, self.at_ns
        valid = self.fresh.copy()
        steps = self.values[0] - states.position[rows]
        for index in self.jumps.suspects(steps, valid):
            elapsed_ns = int(at_ns[index] - self.shown_ns[index])
            if not self.jumps.can_be(index, float(steps[index]), elapsed_ns, now_ns):
                valid[index] = False
                at_ns[index] = self.shown_ns[index]
        shown = rows[valid]
        states.motion[:, shown] = self.values[:, valid]
        states.valid[rows] = valid
        states.age_ns[rows] = np.where(at_ns < 0, -1, now_ns - at_ns)
        self.shown_ns[:] = at_ns


class BusSamples:
    """The part of one bus: its servos are columns of the arrays of `Samples`."""

    __slots__ = ("_fields", "_first", "_samples", "at_ns", "fresh")

    def __init__(self, plan: BusPlan, samples: Samples, first: int) -> None:
        here = slice(first, first + len(plan.servos))
        self._samples = samples
        self._first = first
        self._fields = [
            (servo.state.position, servo.state.velocity, servo.state.effort) for servo in plan.servos
        ]
        self.fresh = samples.fresh[here]
        """True where an intact reply arrived in this cycle; shape (servos of the bus,)."""
        self.at_ns = samples.at_ns[here]
        """Time at which the newest plausible reply arrived; -1 while none ever did."""

    def take(self, servo: int, data: bytes | memoryview, at_ns: int) -> None:
        """Keep what a servo, by its index in the plan, answered to the read of its state."""
        samples, column = self._samples, self._first + servo
        values, scale = samples.values, samples.scale
        for number, field in enumerate(self._fields[servo]):
            values[number, column] = _tick(field, data) * scale[number, column]
        values[0, column] -= samples.reference[column]
        self.fresh[servo] = True
        self.at_ns[servo] = at_ns


def _tick(field: Field, data: bytes | memoryview) -> int:
    """Return an item of a reply as the servo counts.

    Velocity and effort are sign-magnitude in Protocol 1.0 and of XL-320 (e-Manual AX-12A, Present Speed
    (38); XL-320, Present Speed (39)), bits above the sign are ignored; else two's complement (e-Manual
    XM430-W350, Present Velocity (128)).
    """
    raw = data[field.offset : field.offset + field.size]
    if field.encoding == "sign_magnitude":
        value = int.from_bytes(raw, "little")
        return -(value & (_CLOCKWISE - 1)) if value & _CLOCKWISE else value & (_CLOCKWISE - 1)
    return int.from_bytes(raw, "little", signed=field.encoding == "twos_complement")


def _units(servo: ServoPlan) -> tuple[float, float, float]:
    """Return what a tick of position, velocity and effort is, with the joint's sign."""
    units = servo.rad_per_tick, servo.rad_s_per_tick, servo.effort_per_tick
    position, velocity, effort = (servo.direction * unit for unit in units)
    return position, velocity, effort


def _in_wheel_mode(servo: ServoPlan) -> float:
    """Return the unit of the present speed in wheel mode, rad/s."""
    units = [mode.present_rad_s_per_tick for mode in servo.modes if mode.mode == Mode.VELOCITY]
    return units[0] if units else servo.rad_s_per_tick
