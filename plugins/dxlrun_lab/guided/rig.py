"""Rig: a run that an experiment works on, by the client of a running robot; virtual_rig.py has another robot
that answers it.

Each cycle is taken from the log that the run writes, on virtual time from the loop itself.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import starmap
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import DxlrunError, InputError, LogError, Refused, RemoteRobot
from dxlrun.tooling.live import Code, RunGone
from dxlrun.tooling.logs import LogFollower
from dxlrun.tooling.plans import Plan, RecordingPlan, from_json
from dxlrun.tooling.records import Event, EventCode, GoalReport
from dxlrun_lab.guided.own_run import OwnRun

TORQUED = ("on", "doubt")
"""Torque of joints that can be moved, see channels/cycle.py."""
_LOOK_S = 0.1
_STOPPING_S = 3.0
_LOG_S = 5.0
"""How long the log may be behind: the recorder writes twice a second."""
Cycles = NDArray[np.void]
Look = Callable[[], tuple[Cycles, Sequence[Event]]]
"""Returns the cycles and events since the last call."""


class RunningController(NamedTuple):
    """A controller of the run."""

    name: str
    active: bool
    joints: tuple[str, ...]
    """Those that it commands; empty: none."""


class JointNow(NamedTuple):
    """A joint in the newest cycle; NaN: not known."""

    position: float
    goal_position: float
    torque: str
    """Name of a Torque, in lower case."""


class Rig:
    """A run that an experiment works on. Everything raises Refused with the reason, and RunGone."""

    def __init__(
        self,
        robot: RemoteRobot,
        plan: Plan,
        look: Look,
        *,
        log: Path | None,
        end: Callable[[], Sequence[str]] | None = None,
        now_s: Callable[[], float] | None = None,
    ) -> None:
        """`log`: None on virtual time without one. `end`: of a run that belongs to the experiment, which may
        deactivate its controllers; returns what went wrong with it. `now_s`: virtual time."""
        self.robot, self.plan, self.log = robot, plan, log
        self.own, self.virtual = end is not None, now_s is not None
        self._look, self._end = look, end or tuple
        self._now_s = now_s or time.monotonic
        self._cycles = [look()[0][:0].copy()]
        self._times: dict[tuple[int, int], int] = {}
        """When a goal began and ended, ns, by its number and the event."""

    @contextmanager
    def _asking(self) -> Iterator[RemoteRobot]:
        """Turn the end of the connection into RunGone."""
        try:
            yield self.robot
        except (Refused, RunGone):
            raise
        except DxlrunError as error:
            raise RunGone(f"the run of {self.robot.name} ended, or its gateway did ({error})") from error

    def _info(self) -> dict[str, object]:
        with self._asking() as robot:
            return robot.info()

    @property
    def now_s(self) -> float:
        """Time of the run, s."""
        return self._now_s()

    @property
    def rate(self) -> float:
        """Hz of the loop now."""
        return float(str(self._info()["rate"]))

    @property
    def paused(self) -> bool:
        """True where a client paused the run."""
        return bool(self._info()["paused"])

    def controllers(self) -> tuple[RunningController, ...]:
        """Return the controllers that are loaded."""
        rows = self._info()["controllers"]
        return tuple(
            RunningController(
                str(row["name"]),
                bool(row["active"]),
                tuple(map(str, row["joints"])) if row["command"] else (),
            )
            for row in (rows if isinstance(rows, list) else [])
        )

    def joints(self) -> Mapping[str, JointNow]:
        """Return the joints as they are in the newest cycle."""
        with self._asking() as robot:
            states = robot.states()
        rows = zip(states.position.tolist(), states.goal_position.tolist(), states.torque, strict=True)
        return dict(zip(states.joints, starmap(JointNow, rows), strict=True))

    def load(self, name: str, entry: Mapping[str, object]) -> None:
        """Load a controller, in a pause of its own."""
        with self._pause() as robot:
            robot.load(name, entry)

    def unload(self, name: str) -> None:
        """Unload a controller, in a pause of its own."""
        with self._pause() as robot:
            robot.unload(name)

    @contextmanager
    def _pause(self) -> Iterator[RemoteRobot]:
        """Pause the run; one that another client has paused stays so."""
        with self._asking() as robot:
            try:
                robot.pause()
                paused = True
            except Refused as refusal:
                if refusal.code != Code.PAUSED_ALREADY:
                    raise
                paused = False
            try:
                yield robot
            finally:
                if paused:
                    robot.resume()

    def switch(self, activate: Sequence[str], deactivate: Sequence[str]) -> None:
        """Activate and deactivate controllers in one cycle; returns when they are."""
        with self._asking() as robot:
            robot.switch(activate, deactivate)

    def change_rate(self, rate: float) -> None:
        """Run the loop at another rate, Hz."""
        with self._asking() as robot:
            robot.rate(rate)

    def send(self, controller: str, kind: str, command: Mapping[str, object]) -> int:
        """Send a command, from which on cycles are kept; return its goal's number, 0 where it is none."""
        self._record()
        self._cycles, self._times = self._cycles[:1], {}
        with self._asking() as robot:
            goal = robot.send(controller, kind, command).goal
        return goal.number if goal else 0

    def wait(self, goal: int, look: Callable[[], str | None], longest_s: float) -> tuple[str, str]:
        """Wait for the end of a goal; return its outcome and text. Where `look`, called ten times a second of
        the run, returns a sentence, or after `longest_s`, cancel it."""
        until = self.now_s + longest_s
        with self._asking() as robot:
            while (end := robot.goal_state(goal, _LOOK_S)).status == "running":
                why = look()
                if why is None and self.now_s > until:
                    why = f"the samples were not played within {longest_s:.0f} s"
                if why is not None:
                    with suppress(Refused):  # it has ended already
                        robot.cancel(goal)
                        robot.goal_state(goal, _STOPPING_S)  # a controller whose joint is lost may not end it
                    return "cancelled", why
        return end.status, end.text

    def recorded(self, goal: int) -> Cycles:
        """Return the cycles of the goal that was sent last, when the log has them: from the one that took it
        to the one in which it ended, or the last."""
        give_up = time.monotonic() + _LOG_S
        self._record()
        while not (self.virtual or self._whole(goal) or time.monotonic() > give_up):
            time.sleep(_LOOK_S)
            self._record()
        cycles = np.concatenate(self._cycles)
        begun_ns, ended_ns = (self._times.get((goal, code)) for code in _BEGUN_AND_ENDED)
        if begun_ns is None:
            return cycles[:0]
        # an event of a cycle is left between its wake-up and its last write
        written = cycles["written_ns"]
        end = len(cycles) if ended_ns is None else int(np.searchsorted(written, ended_ns)) + 1
        return cycles[int(np.searchsorted(written, begun_ns)) : end]

    def _whole(self, goal: int) -> bool:
        """Return whether the cycle is there in which a goal ended."""
        ended_ns = self._times.get((goal, EventCode.GOAL_ENDED))
        return ended_ns is not None and bool((self._cycles[-1]["written_ns"][-1:] >= ended_ns).any())

    def _record(self) -> None:
        with suppress(LogError):  # it was moved away: what is missing shows in what was recorded
            cycles, events = self._look()
            if len(cycles):
                self._cycles.append(cycles)
            for event in events:
                if event.code in _BEGUN_AND_ENDED:
                    report = msgspec.json.decode(event.data, type=GoalReport)
                    self._times[report.goal, event.code] = event.t_ns

    def close(self) -> Sequence[str]:
        """Let go of the run, end it where it is the experiment's own; return what went wrong with it."""
        self.robot.close()
        return self._end()


_BEGUN_AND_ENDED = EventCode.GOAL_ACCEPTED, EventCode.GOAL_ENDED


def live_rig(robot: RemoteRobot, run: OwnRun | None = None) -> Rig:
    """Return the rig of a running robot; with `run`, of one that was started for the experiment.

    Raises InputError when the robot records no log, or not all of it.
    """
    log = robot.info()["log"]
    if log is None:
        raise InputError(
            f"{robot.name} records no log, from which an experiment takes what it measures; "
            "start it without --no-record"
        )
    follower = LogFollower(str(log))
    plan = from_json(follower.new().attachments["plan.json"])
    require_whole(plan.recording, robot.name)

    def look() -> tuple[Cycles, Sequence[Event]]:
        new = follower.new()
        return new.cycles, new.events

    return Rig(robot, plan, look, log=Path(str(log)), end=run.end if run else None)


def require_whole(recording: RecordingPlan, robot: str) -> None:
    """Raise InputError where the log loses its beginning."""
    if recording.keep_ns is not None:
        raise InputError(
            f"{robot} deletes the oldest parts of its log, and an experiment takes what it measures from the "
            "log; take `keep` out of its `recording`"
        )
