"""Rig: what an experiment does with the run of a robot: read states, load controllers, send goals, record.

The cycles are read from the log that the run is writing. On virtual time (virtual_rig.py) they come directly
from the loop.
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
"""Names of the torque states in which a joint can be moved (see channels/cycle.py)"""
_LOOK_S = 0.1
_STOPPING_S = 3.0
_LOG_S = 5.0
"""Timeout for the last cycle of a goal to appear in the log, s. The recorder writes twice a second."""
Cycles = NDArray[np.void]
Look = Callable[[], tuple[Cycles, Sequence[Event]]]
"""Function that returns the run's cycles and events since its last call"""


class RunningController(NamedTuple):
    """Controller that is loaded in the run"""

    name: str
    active: bool
    joints: tuple[str, ...]
    """Joints that it commands; empty for a broadcaster"""


class JointNow(NamedTuple):
    """State of a joint in the newest cycle; positions in rad, NaN if unknown"""

    position: float
    goal_position: float
    torque: str
    """Torque state, such as `on` or `limp`: the name of a Torque in lower case"""


class Rig:
    """Run of an experiment, and the recording of its cycles.

    Methods raise Refused if the run refuses a request, and RunGone if it has ended.
    """

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
        """Connect the experiment to a run, whose cycles are recorded from now on.

        Args:
            robot: Connection to the run.
            plan: Plan of the run.
            look: Function that returns new cycles and events.
            log: Log of the run; None on virtual time without a log.
            end: Function that ends a run of the experiment's own and returns its errors. The experiment may
                deactivate the controllers of that run.
            now_s: Clock of virtual time, s.
        """
        self.robot, self.plan, self.log = robot, plan, log
        self.own, self.virtual = end is not None, now_s is not None
        self._look, self._end = look, end or tuple
        self._now_s = now_s or time.monotonic
        self._cycles = [look()[0][:0].copy()]
        self._times: dict[tuple[int, int], int] = {}
        """Times of the start and end of goals, ns, by number and event"""

    @contextmanager
    def _asking(self) -> Iterator[RemoteRobot]:
        """Yield the connection to the run; its connection errors become RunGone."""
        try:
            yield self.robot
        except (Refused, RunGone):
            raise
        except DxlrunError as error:
            raise RunGone(f"the run of {self.robot.name} or its gateway ended ({error})") from error

    def _info(self) -> dict[str, object]:
        with self._asking() as robot:
            return robot.info()

    @property
    def now_s(self) -> float:
        """Time for timeouts, s: monotonic, or virtual time"""
        return self._now_s()

    @property
    def rate(self) -> float:
        """Present loop rate, Hz"""
        return float(str(self._info()["rate"]))

    @property
    def paused(self) -> bool:
        """True if a client has paused the run"""
        return bool(self._info()["paused"])

    def controllers(self) -> tuple[RunningController, ...]:
        """Return all loaded controllers of the run."""
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
        """Return the state of each joint of the robot in the newest cycle, by name."""
        with self._asking() as robot:
            states = robot.states()
        rows = zip(states.position.tolist(), states.goal_position.tolist(), states.torque, strict=True)
        return dict(zip(states.joints, starmap(JointNow, rows), strict=True))

    def load_controller(self, name: str, entry: Mapping[str, object]) -> None:
        """Load a controller by its robot file entry, while the run is paused."""
        with self._pause() as robot:
            robot.load(name, entry)

    def unload_controller(self, name: str) -> None:
        """Unload a controller while the run is paused."""
        with self._pause() as robot:
            robot.unload(name)

    @contextmanager
    def _pause(self) -> Iterator[RemoteRobot]:
        """Pause the run, yield its connection, and resume it unless another client had paused it."""
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
        """Activate and deactivate controllers in one cycle, and wait for that cycle."""
        with self._asking() as robot:
            robot.switch(activate, deactivate)

    def change_rate(self, rate: float) -> None:
        """Set the loop rate of the run, Hz."""
        with self._asking() as robot:
            robot.rate(rate)

    def send_command(self, controller: str, kind: str, command: Mapping[str, object]) -> int:
        """Send a command to a controller; return the number of its goal, or 0 if it has none.

        The recording starts again: earlier cycles are dropped.
        """
        self._record()
        self._cycles, self._times = self._cycles[:1], {}
        with self._asking() as robot:
            goal = robot.send(controller, kind, command).goal
        return goal.number if goal else 0

    def wait_for_goal(self, goal: int, look: Callable[[], str | None], longest_s: float) -> tuple[str, str]:
        """Wait for the end of a goal.

        The goal is cancelled after `longest_s`, or when `look` returns a reason. `look` is called ten times
        per second of the run.

        Returns:
            Status of the goal (`reached`, `cancelled` ...), and its text or the reason of the cancellation.
        """
        until = self.now_s + longest_s
        with self._asking() as robot:
            while (end := robot.goal_state(goal, _LOOK_S)).status == "running":
                why = look()
                if why is None and self.now_s > until:
                    why = f"the samples were not played within {longest_s:.0f} s"
                if why is not None:
                    with suppress(Refused):  # the goal has ended already
                        robot.cancel(goal)
                        robot.goal_state(goal, _STOPPING_S)  # with a lost joint, the goal may not end
                    return "cancelled", why
        return end.status, end.text

    def recorded(self, goal: int) -> Cycles:
        """Wait until the cycles of the last sent goal are in the log, and return their records.

        They start with the cycle that accepted the goal, and end with the one in which it ended, or the last.
        """
        give_up = time.monotonic() + _LOG_S
        self._record()
        while not (self.virtual or self._whole(goal) or time.monotonic() > give_up):
            time.sleep(_LOOK_S)
            self._record()
        cycles = np.concatenate(self._cycles)
        begun_ns, ended_ns = (self._times.get((goal, code)) for code in _BEGUN_AND_ENDED)
        if begun_ns is None:
            return cycles[:0]
        # The event of a cycle is stamped between its wake-up and its last write.
        written = cycles["written_ns"]
        end = len(cycles) if ended_ns is None else int(np.searchsorted(written, ended_ns)) + 1
        return cycles[int(np.searchsorted(written, begun_ns)) : end]

    def _whole(self, goal: int) -> bool:
        """Return True if the cycle in which a goal ended has been read from the log."""
        ended_ns = self._times.get((goal, EventCode.GOAL_ENDED))
        return ended_ns is not None and bool((self._cycles[-1]["written_ns"][-1:] >= ended_ns).any())

    def _record(self) -> None:
        with suppress(LogError):  # the log was moved away, so the recording will be incomplete
            cycles, events = self._look()
            if len(cycles):
                self._cycles.append(cycles)
            for event in events:
                if event.code in _BEGUN_AND_ENDED:
                    report = msgspec.json.decode(event.data, type=GoalReport)
                    self._times[report.goal, event.code] = event.t_ns

    def close(self) -> Sequence[str]:
        """Close the connection, and end the run if it was started for the experiment; return its errors."""
        self.robot.close()
        return self._end()


_BEGUN_AND_ENDED = EventCode.GOAL_ACCEPTED, EventCode.GOAL_ENDED


def live_rig(robot: RemoteRobot, run: OwnRun | None = None) -> Rig:
    """Return the rig of a robot that runs in real time, whose cycles are read from its log.

    `run` is its process if it was started for the experiment.

    Raises:
        InputError: The robot records no log, or deletes old parts of the log.
    """
    log = robot.info()["log"]
    if log is None:
        raise InputError(
            f"{robot.name} records no log, but an experiment needs a log; start the robot without --no-record"
        )
    follower = LogFollower(str(log))
    plan = from_json(follower.new().attachments["plan.json"])
    require_whole(plan.recording, robot.name)

    def read_cycles() -> tuple[Cycles, Sequence[Event]]:
        new = follower.new()
        return new.cycles, new.events

    return Rig(robot, plan, read_cycles, log=Path(str(log)), end=run.end_run if run else None)


def require_whole(recording: RecordingPlan, robot: str) -> None:
    """Raise InputError if the run deletes old parts of its log, from which experiments read cycles.

    `robot` is the name or file for the message.
    """
    if recording.keep_ns is not None:
        raise InputError(
            f"{robot} deletes the oldest parts of its log, but an experiment needs the whole log; "
            "remove `keep` from its `recording`"
        )
