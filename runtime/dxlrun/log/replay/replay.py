"""Replay: the same manager, gate and loop on a log's inputs; the report on what was wanted otherwise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dxlrun.control.controllers.manager import Manager
from dxlrun.control.controllers.plugins import PlugIns, load_plugins
from dxlrun.control.gate import Gate
from dxlrun.control.loop import Loop, LoopResult, StopFlag
from dxlrun.control.loop_plan import LoopPlan
from dxlrun.errors import counted
from dxlrun.log.reader import read_log
from dxlrun.log.replay.changes import Setting, with_arguments, with_settings
from dxlrun.log.replay.comparison import Comparison, Difference, JointDifferences
from dxlrun.log.replay.hardware import RecordedClock, RecordedHardware
from dxlrun.log.replay.inputs import PlannedCommands, RecordedInbox
from dxlrun.log.replay.recorded import Recorded, recorded, version_remarks
from dxlrun.run.channels.cycle import CycleLayout, CycleRecord
from dxlrun.run.channels.events import EventCode, Severity


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """What `dxlrun replay` says about a log."""

    log: str
    robot: str
    cycles: int
    """That the log has."""
    compared: int
    different: int
    """Cycles in which anything differs."""
    first: Difference | None
    joints: tuple[JointDifferences, ...]
    """Those of which anything differs."""
    fault: str
    """Why the replay ended before the run did; empty when it did not."""
    stopped: str
    """Why not all cycles were compared; empty when they were, or when `fault` is the reason."""
    remarks: tuple[str, ...]
    """Other versions, damage of the log."""

    @property
    def same(self) -> bool:
        """True when every cycle that can be compared was, and none differs."""
        return not self.different and not self.fault

    @property
    def sentence(self) -> str:
        """The result in one sentence."""
        cycles = counted(self.compared, "cycle", "cycles")
        if self.same:
            return f"{self.robot}: {cycles} replayed, 0 differences"
        if not self.different:
            return f"{self.robot}: {cycles} replayed without a difference, then {self.fault}"
        ended = f"; then {self.fault}" if self.fault else ""
        differ = "differs" if self.different == 1 else "differ"
        return f"{self.robot}: {self.different} of {self.compared} replayed cycles {differ}{ended}"


class _Silence:
    """The events of a replay: the recorded ones are in the log."""

    def emit(self, code: EventCode, severity: Severity, source: str, text: str, data: bytes = b"") -> None:
        """Forget it."""


def replay_log(
    log: Path, settings: Sequence[Setting] = (), arguments: Mapping[str, str] | None = None
) -> ReplayReport:
    """Run the controllers of a log on its inputs and compare what they want; changes are made before.

    Raises LogError when the log does not hold the inputs, PlugInError when a controller is not to be had,
    InputError when a change does not fit, ControllerFault when a controller cannot be configured.
    """
    read = read_log(log)
    inputs = recorded(read)
    plugins = load_plugins()
    loop = with_arguments(inputs.plan, inputs.loop, arguments or {})
    loop = with_settings(loop, settings, plugins)
    comparison, result, refused = _run(inputs, loop, plugins)
    early = comparison.compared < len(inputs.cycles)
    return ReplayReport(
        log=str(log),
        robot=inputs.plan.robot,
        cycles=inputs.in_log,
        compared=comparison.compared,
        different=comparison.different,
        first=comparison.first,
        joints=comparison.joints(),
        fault=f"the replay ended: {result.detail or 'its policy was done'}" if early else "",
        stopped="" if early else inputs.stopped,
        remarks=(*inputs.remarks, *version_remarks(read, inputs.plan.loop, plugins), *refused),
    )


def _run(
    inputs: Recorded, plan: LoopPlan, plugins: PlugIns
) -> tuple[Comparison, LoopResult, tuple[str, ...]]:
    """Put recorded hardware, clock and clients into the loop that runs robots, and run it."""
    names = tuple(joint.name for joint in plan.joints)
    record = CycleRecord(CycleLayout(names, tuple(controller.name for controller in plan.controllers)))
    stop, events = StopFlag(), _Silence()
    clock = RecordedClock(inputs.start_ns - plan.period_ns)
    hardware = RecordedHardware(inputs.cycles, inputs.activation, record, clock, stop, ends=inputs.ends)
    taken = PlannedCommands(inputs.commands, str(inputs.log))
    manager = Manager(plan, plugins, record, events, clock, commands=taken)
    inbox = RecordedInbox(inputs.steered, record)
    comparison = Comparison(plan, inputs.cycles, inputs.start_ns, lambda: manager.plans)
    loop = Loop(
        clock=clock,
        hardware=hardware,
        manager=manager,
        gate=Gate(plan, record, events),
        record=record,
        sink=comparison,
        events=events,
        plan=plan,
        beat=lambda: None,
        stop=stop,
        inbox=inbox,
    )
    manager.configure()
    hardware.start()
    result = loop.run()
    return comparison, result, tuple(inbox.remarks)
