"""Jumps: a position that is further from the last one than the servo can have turned is no sample."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from dxlrun.control_table import control_table
from dxlrun.dynamixel.bus_plan import BusPlan, ServoPlan
from dxlrun.events import EventCode, EventSink, Severity
from dxlrun.interfaces import States

MARGIN_RAD = 0.035
"""rad, two degrees: noise of a potentiometer, and what somebody's hand adds [i]."""
MARGIN_NS = 10_000_000
"""A reply may be that much later than the one before was, so that less time seems to have passed."""
SAY_AGAIN_NS = 1_000_000_000
"""One servo has at most one event in this time."""


class Jumps:
    """Makes rows invalid whose position jumped; they keep their values until the new place can be true.

    What is possible is the servo's highest speed limit times the time since its last good sample, so that a
    servo that really stands elsewhere is believed again after a moment.
    """

    __slots__ = (
        "_delta",
        "_events",
        "_fastest",
        "_good_ns",
        "_last",
        "_mask",
        "_names",
        "_quick",
        "_said_ns",
    )

    def __init__(self, plans: Iterable[BusPlan], joints: int, events: EventSink) -> None:
        self._events = events
        self._fastest = np.full(joints, np.inf)
        self._names = [""] * joints
        for plan in plans:
            for servo in plan.servos:
                self._names[servo.row] = servo.joint
                if not _wraps(servo):
                    self._fastest[servo.row] = _most_speed(plan, servo)
        # a step below this is always possible, whenever the sample before was
        self._quick = self._fastest * MARGIN_NS * 1e-9 + MARGIN_RAD
        self._last = np.full((3, joints), np.nan)
        self._delta = np.zeros(joints)
        self._mask = np.zeros(joints, dtype=np.bool_)
        self._good_ns = np.zeros(joints, dtype=np.int64)
        self._said_ns = [-SAY_AGAIN_NS] * joints

    def sift(self, states: States, now_ns: int) -> None:
        """Look at the positions of a cycle that was just read."""
        np.subtract(states.position, self._last[0], out=self._delta)
        np.abs(self._delta, out=self._delta)
        np.greater(self._delta, self._quick, out=self._mask)
        if np.count_nonzero(self._mask):
            for row in np.flatnonzero(self._mask & states.valid).tolist():
                self._judge(states, row, now_ns)
        if np.count_nonzero(states.valid) != states.valid.size:
            # what was not believed made nothing younger
            lasting = ~states.valid & (self._good_ns > 0)
            np.maximum(states.age_ns, now_ns - self._good_ns, out=states.age_ns, where=lasting)
        self._last[0], self._last[1], self._last[2] = states.position, states.velocity, states.effort
        np.copyto(self._good_ns, now_ns, where=states.valid)

    def _judge(self, states: States, row: int, now_ns: int) -> None:
        elapsed_ns = now_ns - int(self._good_ns[row])
        if self._delta[row] <= self._quick[row] + self._fastest[row] * elapsed_ns * 1e-9:
            return
        states.valid[row] = False
        states.position[row], states.velocity[row], states.effort[row] = self._last[:, row]
        if now_ns - self._said_ns[row] >= SAY_AGAIN_NS:
            self._said_ns[row] = now_ns
            jump, time = np.degrees(self._delta[row]), elapsed_ns * 1e-6
            name = self._names[row]
            text = f"{name} jumped by {jump:.0f} deg in {time:.0f} ms, faster than it can turn: not believed"
            self._events.emit(EventCode.IMPLAUSIBLE, Severity.WARNING, name, text)


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
