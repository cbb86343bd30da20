"""A rig on virtual time: simulated servos in this process, for `--virtual` and for tests."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import msgspec

from dxlrun.channels.answers import Done, Refusal, Waiting
from dxlrun.channels.commands import LOOP, Command
from dxlrun.channels.events import EventCode, GoalReport, decode_event
from dxlrun.channels.ring import Payload, RecordKind
from dxlrun.control.controllers.plugins import load_plugins
from dxlrun.errors import Refused
from dxlrun.plan.loop_plan import ControllerPlan
from dxlrun.plan.robot_plan import Plan
from dxlrun.remote.joints import joint_state
from dxlrun.remote.preparation import Preparation, RefusedRequest
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun_lab.guided.rig import GoalEnd, JointNow, Rig, RunGone, RunningController, Tape, now_of

_ANSWER_S = 10.0
"""Of virtual time, in which a command must be answered."""
ORIGIN = "experiment"


class VirtualRig(Rig):
    """A robot on virtual time whose loop runs in a thread, in turns with the experiment: one of both waits.

    So an experiment is written as if the robot ran beside it, and two runs do exactly the same.
    `each_cycle` is called in every cycle with its number, in the robot's turn: tests inject faults there.
    """

    virtual = own = True

    def __init__(
        self,
        plan: Plan,
        *,
        log: Path | None = None,
        each_cycle: Callable[[int], None] = lambda cycle: None,
    ) -> None:
        self.plan, self.log = plan, log
        self.robot = VirtualRobot(plan, log=log, watch=self._watch)
        self.tape = Tape(self.robot.record.layout.dtype)
        loop = plan.loop
        joints = {joint.name: joint for joint in loop.joints}
        self._preparation = Preparation(joints, load_plugins(), loop.sources, loop.urdf)
        self._loaded = {one.name: (one, place) for place, one in enumerate(plan.loop.controllers)}
        self._rate = 1e9 / plan.loop.period_ns
        self._number = 0
        self._ends: dict[int, GoalReport] = {}
        self._each_cycle = each_cycle
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
            self.robot.run()
        except BaseException as error:  # it is raised in the experiment's turn
            self._error = error
        finally:
            self._our_turn.release()

    def _watch(self, kind: RecordKind, payload: Payload) -> None:
        if kind is RecordKind.EVENT:
            event = decode_event(payload)
            self.tape.take_events([event])
            if event.code == EventCode.GOAL_ENDED:
                report = msgspec.json.decode(event.data, type=GoalReport)
                self._ends[report.goal] = report
        elif kind is RecordKind.CYCLE:
            cycle = self.robot.record.cycle
            if cycle < 0:  # the record before the first cycle
                return
            self.tape.take_cycles(bytes(payload))
            self._each_cycle(cycle)
            if self._due():
                self._our_turn.release()
                self._robots_turn.acquire()

    # The experiment's turn

    def _until(self, due: Callable[[], bool]) -> None:
        """Let the robot run until a cycle at whose end `due` is true. Raises RunGone when it ends before."""
        if not self._thread.is_alive():
            raise RunGone(self._why())
        self._due = due
        self._robots_turn.release()
        self._our_turn.acquire()
        if self._error is not None or self.robot.result is not None:
            self._thread.join()
            if not due():
                raise RunGone(self._why())

    def _why(self) -> str:
        result = self.robot.result
        detail = str(self._error or (result.detail if result else ""))
        return f"the run of {self.plan.robot} ended{f': {detail}' if detail else ''}"

    @property
    def rate(self) -> float:
        """Hz of the loop now."""
        return self._rate

    @property
    def paused(self) -> bool:
        """False: no other client is there."""
        return False

    @property
    def now_s(self) -> float:
        """Virtual time, s."""
        return self.robot.clock.now_ns() * 1e-9

    def controllers(self) -> tuple[RunningController, ...]:
        """Return the controllers that are loaded."""
        active = int(self.robot.record.active)
        return tuple(
            RunningController(
                plan.name, plan.type, bool(active >> place & 1), plan.joints if plan.command else ()
            )
            for plan, place in self._loaded.values()
        )

    def joints(self) -> Mapping[str, JointNow]:
        """Return the joints as they are in the newest cycle."""
        record = self.robot.record
        return {
            joint.name: now_of(joint_state(record, row)) for row, joint in enumerate(self.plan.loop.joints)
        }

    def load(self, name: str, entry: Mapping[str, object]) -> None:
        """Load a controller, in a pause of its own."""
        others = {one: plan for one, (plan, _) in self._loaded.items()}
        try:
            plan = self._preparation.controller({**entry, "name": name}, others, self._rate)
        except RefusedRequest as error:
            raise _refused(error.refusal) from error
        with_place = self._in_pause("load", msgspec.json.encode(plan))
        self._loaded[name] = (plan, with_place.place or 0)

    def unload(self, name: str) -> None:
        """Unload a controller, in a pause of its own."""
        self._in_pause("unload", msgspec.json.encode({"controller": name}))
        del self._loaded[name]

    def _in_pause(self, kind: str, data: bytes) -> Done:
        self._ask(LOOP, "pause")
        try:
            return self._ask(LOOP, kind, data)
        finally:
            self._ask(LOOP, "resume")

    def switch(self, activate: Sequence[str], deactivate: Sequence[str]) -> None:
        """Activate and deactivate controllers in one cycle; returns when they are."""
        names = {"activate": list(activate), "deactivate": list(deactivate)}
        self._ask(LOOP, "switch", msgspec.json.encode(names))

    def change_rate(self, rate: float) -> None:
        """Run the loop at another rate, Hz."""
        self._ask(LOOP, "rate", msgspec.json.encode({"rate": rate}))
        self._rate = rate

    def send(self, controller: str, kind: str, command: Mapping[str, object]) -> int:
        """Send a command; return the number of its goal, 0 where it is none."""
        plan: ControllerPlan = self._loaded[controller][0]
        try:
            prepared = self._preparation.command(plan, kind, msgspec.json.encode(command))
            prepared.require_within_limits()
        except RefusedRequest as error:
            raise _refused(error.refusal) from error
        self.tape.clear()
        done = self._ask(controller, kind, prepared.data, prepared.request)
        return done.goals[0] if done.goals else 0

    def _ask(self, controller: str, kind: str, data: bytes = b"", request: bytes = b"") -> Done:
        """Put a command into the inbox and return its last answer; raises Refused."""
        self._number += 1
        number, answers = self._number, self.robot.inbox.answers
        self.robot.inbox.waiting.append(Command(number, controller, kind, data, ORIGIN, request=request))
        limit_s = self.now_s + _ANSWER_S

        def answered() -> bool:
            answer = answers.get(number)
            return (answer is not None and not isinstance(answer, Waiting)) or self.now_s > limit_s

        self._until(answered)
        answer = answers.pop(number, None)
        if isinstance(answer, Done):
            return answer
        if isinstance(answer, Refusal):
            raise _refused(answer)
        raise RunGone(f"the loop of {self.plan.robot} did not answer within {_ANSWER_S:g} s")

    def end_of(self, goal: int, timeout_s: float) -> GoalEnd | None:
        """Wait for the end of a goal, in virtual time."""
        due_s = self.now_s + timeout_s
        if goal not in self._ends:
            self._until(lambda: goal in self._ends or self.now_s >= due_s)
        report = self._ends.get(goal)
        return None if report is None else GoalEnd(report.status, report.text)

    def cancel(self, goal: int) -> None:
        """Cancel a goal."""
        self._ask(LOOP, "cancel", msgspec.json.encode({"goal": goal}))

    def close(self) -> Sequence[str]:
        """End the run; return what went wrong at its end."""
        if self._thread.is_alive():
            self.robot.stop.request()
            self._due = lambda: False
            self._robots_turn.release()
            self._thread.join()
        return self.robot.failures


def _refused(refusal: Refusal) -> Refused:
    return Refused(refusal.text, code=refusal.code, fields=refusal.fields)
