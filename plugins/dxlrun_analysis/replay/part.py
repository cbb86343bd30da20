"""A part of a log replayed: recorded hardware, clock and clients in the loop that runs robots."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

import numpy as np
from msgspec import structs

from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.events import EventCode, Severity
from dxlrun.control.controllers.manager import Manager
from dxlrun.control.controllers.plugins import PlugIns
from dxlrun.control.controllers.topics import TopicLog
from dxlrun.control.gate import Gate
from dxlrun.control.loop import Loop, LoopResult, StopFlag
from dxlrun.control.state.loop_state import ControllerState, LoopState, controller_state, loop_state
from dxlrun.control.state.object_state import StateError
from dxlrun.errors import LogError
from dxlrun.log.reader import UNREADABLE
from dxlrun.plan.loop_plan import LoopPlan
from dxlrun_analysis.replay.comparison import Comparison
from dxlrun_analysis.replay.inputs import PlannedCommands, RecordedClock, RecordedHardware, RecordedInbox
from dxlrun_analysis.replay.prepared import PreparedComparison
from dxlrun_analysis.replay.published import MessageComparison
from dxlrun_analysis.replay.recorded import RecordedInputs, RecordedPart
from dxlrun_analysis.replay.standing_in import RecordedController
from dxlrun_analysis.replay.tape import Round, Tape


class _Silence:
    """The events of a replay: the recorded ones are in the log."""

    def emit(self, code: EventCode, severity: Severity, source: str, text: str, data: bytes = b"") -> None:
        """Forget it."""


@dataclass(slots=True)
class PartReplay:
    """Replays the parts of a log one after the other."""

    inputs: RecordedInputs
    plan: LoopPlan
    plugins: PlugIns
    messages: MessageComparison
    prepared: PreparedComparison
    comparison: Comparison
    tape: Tape
    epoch_offset_ns: int
    ended: bool
    """The log has the end of its run."""
    remarks: list[str] = field(default_factory=list)

    def run(self, part: RecordedPart) -> LoopResult:
        """Replay a part, from the activation or from its snapshots. Raises LogError when those do not fit."""
        inputs, plan = self.inputs, self.plan
        record = CycleRecord(plan.layout)
        stop, events = StopFlag(), _Silence()
        clock = RecordedClock(inputs.start_ns - plan.period_ns)
        hardware = RecordedHardware(inputs, part, self.tape.row, record, clock, stop)
        taken = PlannedCommands(inputs.commands, str(inputs.log))
        topics = TopicLog(record, self.messages, self.epoch_offset_ns)
        woken = inputs.cycles["woken_ns"]
        after_ns = -1 if part.start is None else int(woken[part.first - 1])
        snapshots = _Snapshots(part, inputs, self.messages)
        self.messages.begin(
            max(after_ns, snapshots.known_ns),
            int(woken[part.end - 1]),
            snapshots.unknown,
            whole=self.ended and part.end == len(inputs.cycles),
        )
        manager = Manager(
            plan, self.plugins, record, events, clock, commands=taken, topics=topics, kept=inputs.kept
        )
        inbox = RecordedInbox(
            inputs.steered, record, lambda taken: self.prepared.of_client(taken, manager.controller)
        )
        loop = Loop(
            clock=clock,
            hardware=hardware,
            manager=manager,
            gate=Gate(plan, record, events),
            record=record,
            sink=self.comparison,
            events=events,
            plan=plan,
            beat=lambda: None,
            stop=stop,
            inbox=inbox,
        )
        self.tape.row(max(0, part.first - 1))  # what is published before the first cycle finds its messages
        manager.configure()
        hardware.start()
        self.comparison.begin_part(manager, hardware, lambda cycle: snapshots.wake(cycle, manager))
        if part.start is not None:
            snapshots.restore(loop, manager, plan, hardware)
        result = loop.run()
        self.remarks += snapshots.remarks
        self.remarks += inbox.remarks
        early = hardware.index < part.end
        reached = max(part.first, hardware.index) - 1
        self.messages.finish((int(woken[reached]) if reached >= 0 else -1) - early)
        return result


class _Snapshots:
    """The snapshots from which a part goes on: the loop's at once, each controller's when its cycle is over.

    Until then, and where there is none, what it commanded in the run stands in for a controller.
    """

    def __init__(self, part: RecordedPart, inputs: RecordedInputs, messages: MessageComparison) -> None:
        """Raises LogError when the loop's state is none."""
        self.remarks: list[str] = []
        self.unknown: set[str] = set()
        """Controllers whose state is not in the log."""
        self.known_ns = -1
        """Wake-up of the cycle behind which all others' are known."""
        self._messages = messages
        self._inputs = inputs
        self._loop: LoopState | None = None
        self._pending: dict[int, list[tuple[str, ControllerState]]] = {}
        if part.start is not None:
            self._read(part, part.start)

    def _read(self, part: RecordedPart, start: Round) -> None:
        cycles = self._inputs.cycles
        try:
            self._loop = loop_state(zlib.decompress(start.loop))
        except (*UNREADABLE, zlib.error) as error:
            raise self._misfit(start.cycle, error) from error
        for name in self._loop.manager.managed:
            cycle, data = start.controllers.get(name, (-1, b""))
            state, problem = None, "the log has none"
            try:
                state = controller_state(zlib.decompress(data)) if data else None
            except (*UNREADABLE, zlib.error) as error:
                problem = str(error)
            if state is None or state.problem or cycle >= int(cycles["cycle"][part.end - 1]):
                self._leave(name, start.cycle, problem if state is None else state.problem)
                continue
            self._pending.setdefault(cycle, []).append((name, state))
            at = int(np.searchsorted(cycles["cycle"], cycle))
            self.known_ns = max(self.known_ns, int(cycles["woken_ns"][at]))

    def _leave(self, name: str, cycle: int, problem: str) -> None:
        self.unknown.add(name)
        why = f" ({problem})" if problem else ""
        self.remarks.append(
            f"{name} is not replayed from cycle {cycle} on: its state is not in the log{why}; the "
            "others meet what it commanded in the run"
        )

    def restore(self, loop: Loop, manager: Manager, plan: LoopPlan, hardware: RecordedHardware) -> None:
        """Let the loop be at the end of the cycle before. Raises LogError when the state does not fit."""
        state = self._loop
        if state is None:
            return
        before = sum(number < state.manager.next for number in self._inputs.taken)
        try:
            loop.restore(structs.replace(state, manager=structs.replace(state.manager, next=before)))
            for name in (*self.unknown, *(name for one in self._pending.values() for name, _ in one)):
                controller = manager.controller(name)
                own = next(one for one in manager.plans if one.name == name)
                if controller is not None:
                    manager.stand_in(name, RecordedController(own, plan, controller, hardware.recorded))
        except (ValueError, LookupError) as error:
            raise self._misfit(state.cycle, error) from error

    def wake(self, cycle: int, manager: Manager) -> None:
        """Let the controllers go on themselves whose state is that of the end of this cycle."""
        for name, state in self._pending.pop(cycle, ()):
            if manager.controller(name) is None:
                continue
            try:
                manager.take_back(name, state)
            except (StateError, ValueError, LookupError) as error:
                self._leave(name, cycle, str(error))
                self._messages.leave_out(name)

    def _misfit(self, cycle: int, error: Exception) -> LogError:
        text = f"the snapshot of cycle {cycle} does not fit this dxlrun and these parameters: {error}"
        return LogError(f"{self._inputs.log}: {text}")
