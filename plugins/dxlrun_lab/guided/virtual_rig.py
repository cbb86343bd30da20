"""A robot on virtual time that answers the client of a running one: for `--virtual` and for tests."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np

from dxlrun.channels.answers import Done, Refusal, Waiting
from dxlrun.channels.commands import LOOP, Command
from dxlrun.channels.events import Event, EventCode, GoalReport, decode_event
from dxlrun.channels.ring import Payload, RecordKind
from dxlrun.control.controllers.plugins import load_plugins
from dxlrun.errors import Refused
from dxlrun.plan.robot_plan import Plan
from dxlrun.remote.client import Executed, GoalState, RemoteGoal, RemoteRobot
from dxlrun.remote.joints import joint_state
from dxlrun.remote.preparation import Preparation, RefusedRequest
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun_lab.guided.rig import Cycles, Rig, RunGone

_ANSWER_S = 10.0
"""Of virtual time, in which a command must be answered."""
ORIGIN = "experiment"
EachCycle = Callable[[int], None]


def virtual_rig(plan: Plan, *, log: Path | None = None, each_cycle: EachCycle = lambda cycle: None) -> Rig:
    """Return the rig of a robot on virtual time; see RobotOnVirtualTime."""
    robot = RobotOnVirtualTime(plan, log=log, each_cycle=each_cycle)
    return Rig(
        robot, plan, robot.new, log=log, end=lambda: robot.simulated.failures, now_s=lambda: robot.now_s
    )


class RobotOnVirtualTime(RemoteRobot):
    """A robot whose loop runs in a thread, in turns with the experiment: one of both waits.

    It does what an experiment asks of a running one. So an experiment is written as if the robot ran beside
    it, and two runs do exactly the same. `each_cycle` gets the number of each cycle, in the robot's
    turn: tests inject faults there.
    """

    def __init__(self, plan: Plan, *, log: Path | None, each_cycle: EachCycle) -> None:
        super().__init__(plan.robot, Path(), ORIGIN)
        self.simulated = VirtualRobot(plan, log=log, watch=self._watch)
        self.each_cycle = each_cycle
        self._plan = plan
        self._cycles: list[bytes] = []
        self._events: list[Event] = []
        loop = plan.loop
        joints = {joint.name: joint for joint in loop.joints}
        self._preparation = Preparation(joints, load_plugins(), loop.sources, loop.urdf)
        self._loaded = {one.name: (one, place) for place, one in enumerate(loop.controllers)}
        self._rate = 1e9 / loop.period_ns
        self._number = 0
        self.ends: dict[int, GoalReport] = {}
        self._due: Callable[[], bool] = lambda: True
        """Ends the robot's turn."""
        self._robots_turn, self._our_turn = threading.Semaphore(0), threading.Semaphore(0)
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        self._our_turn.acquire()
        if self._error is not None:
            raise self._error

    # The robot's turn

    def _run(self) -> None:
        try:
            self.simulated.run()
        except BaseException as error:  # it is raised in the experiment's turn
            self._error = error
        finally:
            self._our_turn.release()

    def _watch(self, kind: RecordKind, payload: Payload) -> None:
        if kind is RecordKind.EVENT:
            event = decode_event(payload)
            self._events.append(event)
            if event.code == EventCode.GOAL_ENDED:
                report = msgspec.json.decode(event.data, type=GoalReport)
                self.ends[report.goal] = report
        elif kind is RecordKind.CYCLE:
            cycle = self.simulated.record.cycle
            if cycle < 0:  # the record before the first cycle
                return
            self._cycles.append(bytes(payload))
            self.each_cycle(cycle)
            if self._due():
                self._our_turn.release()
                self._robots_turn.acquire()

    # The experiment's turn

    @property
    def now_s(self) -> float:
        """Virtual time, s."""
        return self.simulated.clock.now_ns() * 1e-9

    def until(self, due: Callable[[], bool]) -> None:
        """Let the robot run until a cycle at whose end `due` is true. Raises RunGone when it ends before."""
        if not self._thread.is_alive():
            raise RunGone(self._why())
        self._due = due
        self._robots_turn.release()
        self._our_turn.acquire()
        if self._error is not None or self.simulated.result is not None:
            self._thread.join()
            if not due():
                raise RunGone(self._why())

    def _why(self) -> str:
        result = self.simulated.result
        detail = str(self._error or (result.detail if result else ""))
        return f"the run of {self.name} ended{f': {detail}' if detail else ''}"

    def new(self) -> tuple[Cycles, Sequence[Event]]:
        """Return the cycles and events since the last call."""
        cycles = np.frombuffer(b"".join(self._cycles), self.simulated.record.layout.dtype)
        events, self._cycles, self._events = self._events, [], []
        return cycles, events

    def info(self) -> dict[str, object]:
        """Return rate and controllers."""
        active = int(self.simulated.record.active)
        controllers = [
            {"name": one.name, "active": active >> place & 1, "joints": one.joints, "command": one.command}
            for one, place in self._loaded.values()
        ]
        return {"rate": self._rate, "paused": False, "controllers": controllers}

    def states(self) -> dict[str, object]:
        """Return the joints in the newest cycle."""
        names = [joint.name for joint in self._plan.loop.joints]
        return {"joints": {name: joint_state(self.simulated.record, row) for row, name in enumerate(names)}}

    def load(self, name: str, entry: Mapping[str, object]) -> Executed:
        """Load a controller into the paused loop."""
        others = {one: plan for one, (plan, _) in self._loaded.items()}
        try:
            plan = self._preparation.controller({**entry, "name": name}, others, self._rate)
        except RefusedRequest as error:
            raise _refused(error.refusal) from error
        done = self._done(LOOP, "load", msgspec.json.encode(plan))
        self._loaded[name] = (plan, done.place or 0)
        return Executed(done.cycle)

    def unload(self, name: str) -> Executed:
        """Take a controller out of the paused loop."""
        done = self._for_loop("unload", {"controller": name})
        del self._loaded[name]
        return done

    def switch(self, activate: Sequence[str] = (), deactivate: Sequence[str] = ()) -> Executed:
        """Activate and deactivate controllers in one cycle; returns when they are."""
        return self._for_loop("switch", {"activate": list(activate), "deactivate": list(deactivate)})

    def rate(self, rate: float) -> Executed:
        """Run the loop at another rate, Hz."""
        done = self._for_loop("rate", {"rate": rate})
        self._rate = rate
        return done

    def pause(self) -> Executed:
        """Hold the joints, and stop the controllers' time."""
        return Executed(self._done(LOOP, "pause").cycle)

    def resume(self) -> Executed:
        """Let the controllers' time run again."""
        return Executed(self._done(LOOP, "resume").cycle)

    def send(
        self,
        controller: str,
        kind: str,
        command: Mapping[str, object],
        *,
        units: bool = False,
        seconds: float | None = None,
    ) -> Executed:
        """Send a typed command, in SI units; returns when the loop has taken it."""
        plan = self._loaded[controller][0]
        try:
            prepared = self._preparation.command(plan, kind, msgspec.json.encode(command))
            prepared.require_within_limits()
        except RefusedRequest as error:
            raise _refused(error.refusal) from error
        done = self._done(controller, kind, prepared.data, prepared.request)
        return Executed(done.cycle, tuple(RemoteGoal(self, number) for number in done.goals))

    def goal_state(self, number: int, wait: float = 0.0) -> GoalState:
        """Return one goal, when it has ended or after so long, s of virtual time."""
        due_s = self.now_s + wait
        if number not in self.ends:
            self.until(lambda: number in self.ends or self.now_s >= due_s)
        end = self.ends.get(number)
        status, text = ("running", "") if end is None else (end.status, end.text)
        return GoalState(number, "", "", ORIGIN, status, 0.0, None, "", text, None)

    def cancel(self, goal: RemoteGoal | int | str) -> Executed:
        """Cancel a goal."""
        return self._for_loop("cancel", {"goal": goal})

    def _for_loop(self, kind: str, content: Mapping[str, object]) -> Executed:
        return Executed(self._done(LOOP, kind, msgspec.json.encode(content)).cycle)

    def _done(self, controller: str, kind: str, data: bytes = b"", request: bytes = b"") -> Done:
        """Put a command into the inbox and return its last answer; raises Refused."""
        self._number += 1
        number, answers = self._number, self.simulated.inbox.answers
        self.simulated.inbox.waiting.append(Command(number, controller, kind, data, ORIGIN, request=request))
        limit_s = self.now_s + _ANSWER_S

        def answered() -> bool:
            answer = answers.get(number)
            return (answer is not None and not isinstance(answer, Waiting)) or self.now_s > limit_s

        self.until(answered)
        answer = answers.pop(number, None)
        if isinstance(answer, Done):
            return answer
        if isinstance(answer, Refusal):
            raise _refused(answer)
        raise RunGone(f"the loop of {self.name} did not answer within {_ANSWER_S:g} s")

    def close(self) -> None:
        """End the run."""
        if self._thread.is_alive():
            self.simulated.stop.request()
            self._due = lambda: False
            self._robots_turn.release()
            self._thread.join()


def _refused(refusal: Refusal) -> Refused:
    return Refused(refusal.text, code=refusal.code, fields=refusal.fields)
