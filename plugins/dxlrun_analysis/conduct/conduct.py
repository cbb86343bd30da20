"""Behaviour of the robot in a run: goals, failed controllers and their fallbacks, falls.

A robot fell if a fall_reflex had other controllers take over. It is down at the end if gravity, in the frame
of its IMU, ended more than 60 deg from its direction at the start, unless the robot began lying and ended
upright. Gravity comes from the orientation (quaternion of the frame in the world), else from the
acceleration, as the median of some cycles.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import Log
from dxlrun.tooling.logs import UNREADABLE
from dxlrun.tooling.records import Event, EventCode, GoalHistory, GoalReport, GoalTotals
from dxlrun_analysis.cycles.punctuality import begins, first_deadline_ns
from dxlrun_analysis.plan_excerpt import LoggedPlan, plan_of

_FALLEN_RAD = math.radians(60.0)  # Tilt of gravity from which the robot is down
_SOME = 50  # Cycles at the start and at the end whose median gravity is compared
_MOST_KEPT = 100  # Takeovers that are kept
_GOALS = (EventCode.GOAL_ACCEPTED, EventCode.GOAL_ENDED)
_ENDS = (EventCode.LOOP_STARTED, EventCode.LOOP_STOPPED)

Floats = NDArray[np.float64]


class Takeover(NamedTuple):
    """Moment at which other controllers replaced one: its fallback after a failure, or those that it
    requested, such as after a fall."""

    time_s: float  # Since the first deadline
    controller: str  # Controller that failed or requested the takeover
    by: str  # Fallback; empty for a requested takeover
    text: str
    fell: bool = False


@dataclass(frozen=True, slots=True)
class Conduct:
    """Behaviour of the robot in a run: its goals, takeovers, and whether it fell."""

    begin_ns: int = 0  # First deadline, on the run's clock
    goals: GoalTotals = field(default_factory=GoalTotals)
    whole: bool = False  # The log has the first and the last cycle of the run
    takeovers: tuple[Takeover, ...] = ()
    unanswered: tuple[str, ...] = ()  # Controllers that failed and whose fallback did not take over
    turned_rad: float | None = None  # Angle of gravity between start and end; None without an IMU
    lies: bool = False  # The robot was down at the end


NO_CONDUCT = Conduct()
"""Behaviour in a log without goals, takeovers and IMU."""


class ConductHistory:
    """Accumulator of the robot's behaviour, fed slice by slice in constant memory."""

    def __init__(self) -> None:
        self._begin_ns: int | None = None
        self._plan, self._goals = LoggedPlan(), GoalHistory()
        self._ends: set[int] = set()  # LOOP_STARTED and LOOP_STOPPED, if the log has them
        self._takeovers: list[Takeover] = []
        self._pending: list[Event] = []  # Faults of controllers without a takeover so far
        self._first, self._last = np.zeros((0, 3)), np.zeros((0, 3))  # Gravity in the frame of the IMU

    def add_slice(self, log: Log) -> None:
        """Add the events and IMU values of the next slice of the log."""
        if self._begin_ns is None:
            self._plan = plan_of(log)
            self._goals.planned = self._plan.loop.origins
            self._begin_ns = first_deadline_ns(log) if begins(log) else None
        for event in log.events:
            if event.code in _GOALS:
                with suppress(*UNREADABLE):
                    self._goals.count_report(msgspec.json.decode(event.data, type=GoalReport))
            elif event.code in _ENDS:
                self._ends.add(event.code)
            elif event.code == EventCode.TAKEOVER:
                fell = self._plan.controller(event.source).type == "fall_reflex"
                self._take_over(event, "", fell)
            elif event.code == EventCode.CONTROLLER_FAULT:
                self._pending.append(event)
            elif event.code == EventCode.CONTROLLER_ACTIVATED:
                self._activated(event)
        gravity = _gravity(log)
        self._first = np.concatenate([self._first, gravity[: _SOME - len(self._first)]])
        self._last = np.concatenate([self._last, gravity[-_SOME:]])[-_SOME:]

    def _activated(self, event: Event) -> None:
        """Record a takeover if the activated controller is the fallback of a failed one, or the fallback
        of another controller in its place."""
        fallbacks = {one.fallback for one in self._plan.loop.controllers}
        for failed in self._pending:
            own = self._plan.controller(failed.source).fallback
            if event.source == own or (event.source in fallbacks and event.source != failed.source):
                self._take_over(failed, event.source)
                self._pending.remove(failed)
                return

    def _take_over(self, event: Event, by: str, fell: bool = False) -> None:
        if len(self._takeovers) < _MOST_KEPT:
            time_s = (event.t_ns - (self._begin_ns or event.t_ns)) / 1e9
            self._takeovers.append(Takeover(time_s, event.source, by, event.text, fell))

    def summarize_conduct(self) -> Conduct:
        """Return the behaviour over all slices."""
        turned, lies = None, any(one.fell for one in self._takeovers)
        if len(self._first) and len(self._last):
            begin, end = (_unit(np.median(rows, axis=0)) for rows in (self._first, self._last))
            # Clamp because rounding can exceed the domain of acos.
            turned = math.acos(max(-1.0, min(1.0, float(begin @ end))))
            upright = math.cos(_FALLEN_RAD)
            got_up = abs(begin[2]) < upright <= end[2]
            lies = turned > _FALLEN_RAD and not got_up
        return Conduct(
            begin_ns=self._begin_ns or 0,
            goals=self._goals.totals,
            whole=len(self._ends) == len(_ENDS),
            takeovers=tuple(self._takeovers),
            unanswered=tuple(event.source for event in self._pending),
            turned_rad=turned,
            lies=lies,
        )


def _gravity(log: Log) -> Floats:
    """Return the direction of gravity in the frame of the first IMU, for each cycle with valid values;
    shape (cycles, 3), empty without an IMU."""
    sources = log.header.sources
    for names in (("x", "y", "z", "w"), ("x", "y", "z")):
        item = "orientation" if len(names) > 3 else "linear_acceleration"
        wanted = [f"{item}.{name}" for name in names]
        source = next((name for name, states in sources.items() if set(wanted) <= set(states)), None)
        if source is None or not len(log.cycles):
            continue
        begin = log.header.layout.source_slice(source).start
        places = [begin + sources[source].index(name) for name in wanted]
        valid = log.cycles["source_valid"][:, list(sources).index(source)]
        values: Floats = log.cycles["source_state"][valid][:, places]
        values = values[np.isfinite(values).all(axis=1)]
        if len(names) == 3:
            return values
        x, y, z, w = values.T
        # Third row of the rotation matrix of the quaternion: the vertical axis of the world, in the frame.
        return np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    return np.zeros((0, 3))


def _unit(vector: Floats) -> Floats:
    length = float(np.linalg.norm(vector))
    return vector / length if length else vector
