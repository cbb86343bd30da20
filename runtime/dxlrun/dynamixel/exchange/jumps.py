"""Jumps: a position that is further from the last one than the servo can have turned is no sample."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from dxlrun.dynamixel.control_table import control_table
from dxlrun.dynamixel.plan.bus_plan import BusPlan, ServoPlan
from dxlrun.interfaces import Floats
from dxlrun.run.channels.events import EventCode, EventSink, Severity

MARGIN_RAD = 0.035
"""rad, two degrees: noise of a potentiometer, and what somebody's hand adds [i]."""
MARGIN_NS = 10_000_000
"""A reply may be that much later than the one before was, so that less time seems to have passed."""
SAY_AGAIN_NS = 1_000_000_000
"""One servo has at most one event in this time."""


class Jumps:
    """Says whether positions are possible; the steps are in the order of the plans' servos.

    What is possible is the servo's highest speed limit times the time since its last good sample, so that a
    servo that really stands elsewhere is believed again after a moment.
    """

    __slots__ = ("_events", "_fastest", "_mask", "_names", "_said_ns", "always_possible")

    def __init__(self, plans: Iterable[BusPlan], events: EventSink) -> None:
        self._events = events
        both = [(plan, servo) for plan in plans for servo in plan.servos]
        self._names = [servo.joint for _, servo in both]
        speeds = [np.inf if _wraps(servo) else _most_speed(plan, servo) for plan, servo in both]
        self._fastest = np.array(speeds, dtype=np.float64)
        self.always_possible: Floats = self._fastest * MARGIN_NS * 1e-9 + MARGIN_RAD
        """rad; a step up to this is possible, whenever the sample before was."""
        self._mask = np.zeros(len(both), dtype=np.bool_)
        self._said_ns = [-SAY_AGAIN_NS] * len(both)

    def suspects(self, steps: Floats, fresh: NDArray[np.bool_]) -> list[int]:
        """Return who of those that are `fresh` made a step that may be too far, by index; steps in rad."""
        np.greater(np.abs(steps), self.always_possible, self._mask)
        return np.flatnonzero(self._mask & fresh).tolist()

    def can_be(self, index: int, step: float, elapsed_ns: int, now_ns: int) -> bool:
        """Say whether a servo can have made a step in this time; tell of it if it cannot."""
        reach = self.always_possible[index] + self._fastest[index] * elapsed_ns * 1e-9
        if abs(step) <= reach:
            return True
        if now_ns - self._said_ns[index] >= SAY_AGAIN_NS:
            self._said_ns[index] = now_ns
            jump, time, name = np.degrees(abs(step)), elapsed_ns * 1e-6, self._names[index]
            text = f"{name} jumped by {jump:.0f} deg in {time:.0f} ms, faster than it can turn: not believed"
            self._events.emit(EventCode.IMPLAUSIBLE, Severity.WARNING, name, text)
        return False


def _most_speed(plan: BusPlan, servo: ServoPlan) -> float:
    """Return the highest speed of a servo, rad/s: a profile may be set to more than the velocity limit.

    Velocity Limit (44) of an X servo ends at 1023, Profile Velocity (112) at 32767 (e-Manual XM430-W350).
    """
    limit = control_table(servo.model, plan.protocol).items.get("velocity_limit")
    ticks = servo.max_speed_tick if limit is None else min(servo.max_speed_tick, limit.maximum)
    return ticks * servo.rad_s_per_tick


def _wraps(servo: ServoPlan) -> bool:
    """Say whether a position may go from one end of its range to the other in a wheel's turn."""
    return servo.continuous and servo.state.position.size < 4
