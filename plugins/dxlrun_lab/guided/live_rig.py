"""A rig that is a running robot: commands through its gateway, and each cycle from the log that it writes."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dxlrun.channels.answers import Code
from dxlrun.errors import DxlrunError, InputError, LogError, Refused
from dxlrun.log.reader import LogFollower
from dxlrun.plan.recording_plan import RecordingPlan
from dxlrun.plan.robot_plan import from_json
from dxlrun.remote.client import RemoteRobot
from dxlrun_lab.guided.own_run import OwnRun
from dxlrun_lab.guided.rig import GoalEnd, JointNow, Rig, RunGone, RunningController, Tape, now_of

_LOOK_S = 0.1
_LOG_S = 5.0
"""How long the log may be behind: the recorder writes twice a second."""


def require_whole(recording: RecordingPlan, robot: str) -> None:
    """Raise InputError where the log loses its beginning."""
    if recording.keep_ns is not None:
        raise InputError(
            f"{robot} deletes the oldest parts of its log, and an experiment takes what it measures from the "
            "log; take `keep` out of its `recording`"
        )


class LiveRig(Rig):
    """A running robot; with `run`, one that was started for the experiment, and ends with it.

    Raises InputError when the robot records no log, or not all of it.
    """

    virtual = False

    def __init__(self, robot: RemoteRobot, run: OwnRun | None = None) -> None:
        self._robot, self._run = robot, run
        self.own = run is not None
        log = self._info()["log"]
        if log is None:
            raise InputError(
                f"{robot.name} records no log, from which an experiment takes what it measures; "
                "start it without --no-record"
            )
        self.log: Path | None = Path(str(log))
        self._follower = LogFollower(str(log))
        start = self._follower.new()
        self.tape = Tape(start.cycles.dtype)
        self.plan = from_json(start.attachments["plan.json"])
        require_whole(self.plan.recording, robot.name)

    @contextmanager
    def _asking(self) -> Iterator[None]:
        """Turn the end of the connection into RunGone."""
        try:
            yield
        except (Refused, RunGone):
            raise
        except DxlrunError as error:
            raise RunGone(f"the run of {self._robot.name} ended, or its gateway did ({error})") from error

    def _info(self) -> dict[str, object]:
        with self._asking():
            return self._robot.info()

    @property
    def now_s(self) -> float:
        """Monotonic time, s."""
        return time.monotonic()

    @property
    def rate(self) -> float:
        """Hz of the loop now."""
        return float(str(self._info()["rate"]))

    @property
    def paused(self) -> bool:
        """True where a client paused the run."""
        return bool(self._info()["paused"])

    def controllers(self) -> tuple[RunningController, ...]:
        """Return the loaded controllers."""
        rows = self._info()["controllers"]
        return tuple(
            RunningController(
                str(row["name"]),
                str(row["type"]),
                bool(row["active"]),
                tuple(map(str, row["joints"])) if row["command"] else (),
            )
            for row in (rows if isinstance(rows, list) else [])
        )

    def joints(self) -> Mapping[str, JointNow]:
        """Return the joints as they are in the newest cycle."""
        with self._asking():
            rows = self._robot.states()["joints"]
        return {str(name): now_of(row) for name, row in rows.items()} if isinstance(rows, dict) else {}

    def load(self, name: str, entry: Mapping[str, object]) -> None:
        """Load a controller, in a pause of its own."""
        with self._pause():
            self._robot.load(name, entry)

    def unload(self, name: str) -> None:
        """Unload a controller, in a pause of its own."""
        with self._pause():
            self._robot.unload(name)

    @contextmanager
    def _pause(self) -> Iterator[None]:
        """Pause the run; one that another client has paused stays so."""
        with self._asking():
            try:
                self._robot.pause()
                paused = True
            except Refused as refusal:
                if refusal.code != Code.PAUSED_ALREADY:
                    raise
                paused = False
            try:
                yield
            finally:
                if paused:
                    self._robot.resume()

    def switch(self, activate: Sequence[str], deactivate: Sequence[str]) -> None:
        """Activate and deactivate controllers in one cycle; returns when they are."""
        with self._asking():
            self._robot.switch(activate, deactivate)

    def change_rate(self, rate: float) -> None:
        """Run the loop at another rate, Hz."""
        with self._asking():
            self._robot.rate(rate)

    def send(self, controller: str, kind: str, command: Mapping[str, object]) -> int:
        """Send a command; return its goal's number."""
        self._read_log()
        self.tape.clear()
        with self._asking():
            goal = self._robot.send(controller, kind, command).goal
        return goal.number if goal else 0

    def end_of(self, goal: int, timeout_s: float) -> GoalEnd | None:
        """Wait for the end of a goal."""
        until = time.monotonic() + timeout_s
        while True:
            with self._asking():
                state = self._robot.goal_state(goal, min(timeout_s, _LOOK_S))
            if state.status != "running":
                return GoalEnd(state.status, state.text)
            if time.monotonic() >= until:
                return None

    def cancel(self, goal: int) -> None:
        """Cancel a goal."""
        with self._asking():
            self._robot.cancel(goal)

    def recorded(self, goal: int) -> NDArray[np.void]:
        """Return the cycles of a goal when the log has them."""
        until = time.monotonic() + _LOG_S
        while True:
            self._read_log()
            if self.tape.whole(goal) or time.monotonic() > until:
                return super().recorded(goal)
            time.sleep(_LOOK_S)

    def _read_log(self) -> None:
        with suppress(LogError):  # it was moved away: what is missing shows in what was recorded
            new = self._follower.new()
            self.tape.take_cycles(new.cycles.tobytes())
            self.tape.take_events(new.events)

    def close(self) -> Sequence[str]:
        """Let go of the run, or end it where it is the experiment's own; return what went wrong with it."""
        self._robot.close()
        return () if self._run is None else self._run.end()
