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
from dxlrun.plan.robot_plan import Plan
from dxlrun.remote.client import RemoteRobot
from dxlrun.remote.joints import joint_state
from dxlrun.remote.preparation import Preparation, RefusedRequest
from dxlrun.remote.replies import Executed, GoalState, NotDone
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

    def _exchange(self, method: str, path: str, content: Mapping[str, object] | None) -> tuple[int, bytes]:
        """Do what the gateway does with a request: the link of this robot."""
        words = path.partition("?")[0].split("/")[1:]
        try:
            return 200, msgspec.json.encode(self._reply(method, words, path, content or {}))
        except RefusedRequest as error:
            refusal = error.refusal
            return 409, msgspec.json.encode(NotDone(refusal.text, refusal.code, refusal.fields))

    def _reply(self, method: str, words: list[str], path: str, content: Mapping[str, object]) -> object:
        match words:
            case ["robot"]:
                return self._info()
            case ["states"]:
                names = enumerate(joint.name for joint in self._plan.loop.joints)
                return {"joints": {name: joint_state(self.simulated.record, row) for row, name in names}}
            case ["goals", number]:
                return self._goal(int(number), float(path.partition("?wait=")[2] or 0))
            case ["goals", number, "cancel"]:
                done = self._done(LOOP, "cancel", {"goal": int(number)})
            case ["controllers"]:
                others = {name: plan for name, (plan, _) in self._loaded.items()}
                plan = self._preparation.controller(content, others, self._rate)
                done = self._done(LOOP, "load", plan)
                self._loaded[plan.name] = (plan, done.place or 0)
            case ["controllers", name] if method == "DELETE":
                done = self._done(LOOP, "unload", {"controller": name})
                del self._loaded[name]
            case ["controllers", name, "commands", kind]:
                prepared = self._preparation.command(
                    self._loaded[name][0], kind, msgspec.json.encode(content)
                )
                prepared.require_within_limits()
                done = self._done(name, kind, prepared.data, prepared.request)
            case [kind]:  # switch, rate, pause, resume
                done = self._done(LOOP, kind, content or b"")
                self._rate = float(str(content.get("rate", self._rate)))
            case _:
                raise NotImplementedError(path)
        return Executed(done.cycle, done.goals)

    def _info(self) -> dict[str, object]:
        active = int(self.simulated.record.active)
        controllers = [
            {"name": one.name, "active": active >> place & 1, "joints": one.joints, "command": one.command}
            for one, place in self._loaded.values()
        ]
        return {"rate": self._rate, "paused": False, "controllers": controllers}

    def _goal(self, number: int, wait_s: float) -> object:
        """Return how a goal ended, as soon as it has or after so long; that it runs where it has not."""
        due_s = self.now_s + wait_s
        if number not in self.ends:
            self.until(lambda: number in self.ends or self.now_s >= due_s)
        return self.ends.get(number, GoalState(number))

    def _done(self, controller: str, kind: str, content: object, request: bytes = b"") -> Done:
        """Put a command into the inbox and return its last answer; raises RefusedRequest."""
        self._number += 1
        number, answers = self._number, self.simulated.inbox.answers
        data = content if isinstance(content, bytes) else msgspec.json.encode(content)
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
            raise RefusedRequest(answer)
        raise RunGone(f"the loop of {self.name} did not answer within {_ANSWER_S:g} s")

    def close(self) -> None:
        """End the run."""
        if self._thread.is_alive():
            self.simulated.stop.request()
            self._due = lambda: False
            self._robots_turn.release()
            self._thread.join()
