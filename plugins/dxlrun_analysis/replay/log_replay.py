"""`dxlrun replay`: run the controllers of a log again on its recorded inputs, and compare their commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec
from msgspec.structs import replace

from dxlrun import PlugInError, open_log
from dxlrun.tooling.output import counted
from dxlrun.tooling.plans import LoopPlan
from dxlrun.tooling.robots import PlugIns, load_plugins
from dxlrun.tooling.runs import RecordedRun
from dxlrun_analysis.replay.changes import Setting, with_arguments, with_changed_code, with_settings
from dxlrun_analysis.replay.code import CodeChoice, with_code
from dxlrun_analysis.replay.comparison import Comparison, JointDifferences
from dxlrun_analysis.replay.prepared import PreparedComparison
from dxlrun_analysis.replay.published import MessageComparison
from dxlrun_analysis.replay.recorded_inputs import ReplayDifference, code_remarks, recorded, version_remarks
from dxlrun_analysis.replay.tape import Tape, overview


class ReplayReport(msgspec.Struct, frozen=True):
    """Result of `dxlrun replay`: numbers of compared and different cycles, messages and prepared commands."""

    log: str
    robot: str
    cycles: int  # Cycles in the log
    compared: int  # Cycles that were compared, from the first
    last: int  # Number of the last compared cycle
    different: int  # Cycles in which any value differs
    first: ReplayDifference | None
    joints: tuple[JointDifferences, ...]  # Joints with differences
    fault: str  # Reason why the replay ended before the run; empty if it did not
    stopped: str  # Reason why not all cycles were compared; empty if all were, or if `fault` is the reason
    remarks: tuple[str, ...]  # Other versions, damage of the log
    messages: int = 0  # Messages that were compared, or exist in only one of run and replay
    different_messages: int = 0
    prepared: int = 0  # Commands that were prepared again
    different_prepared: int = 0
    unprepared: int = 0
    """Commands that were not prepared again because the log lacks their request: it was too long, or the
    log is from an earlier dxlrun."""

    @property
    def same(self) -> bool:
        """True if no compared value differs and the replay did not end before the run."""
        differ = self.different or self.different_messages or self.different_prepared
        return not differ and not self.fault

    @property
    def sentence(self) -> str:
        """Result in one sentence, with the numbers of cycles and differences."""
        cycles = counted(self.compared, "cycle", "cycles")
        if self.compared < self.cycles:
            cycles = f"cycles 0 to {self.last} ({self.compared} of {self.cycles})"
        if self.same:
            return f"{self.robot}: {cycles} replayed, 0 differences"
        ended = f"; then {self.fault}" if self.fault else ""
        if not self.different and self.different_prepared:
            commands = counted(self.prepared, "prepared command", "prepared commands")
            differ = "differs" if self.different_prepared == 1 else "differ"
            of = f"{self.different_prepared} of {commands} {differ}"
            return f"{self.robot}: {cycles} replayed, {of}{ended}"
        if not self.different and self.different_messages:
            differ = "differs" if self.different_messages == 1 else "differ"
            of = f"{self.different_messages} of {counted(self.messages, 'message', 'messages')}"
            return f"{self.robot}: {cycles} replayed, {of} {differ}{ended}"
        if not self.different:
            return f"{self.robot}: {cycles} replayed without a difference, then {self.fault}"
        differ = "differs" if self.different == 1 else "differ"
        return f"{self.robot}: {self.different} of {self.compared} replayed cycles {differ}{ended}"


def replay_log(
    log: Path,
    settings: Sequence[Setting] = (),
    arguments: Mapping[str, str] | None = None,
    code: CodeChoice | None = None,
) -> ReplayReport:
    """Run the controllers of a log on its recorded inputs and compare their commands with the log.

    Memory does not grow with packets, states and messages of the log.

    Args:
        log: The log.
        settings: Changed parameters.
        arguments: Changed arguments of the robot file.
        code: Source of the controllers' Python files, if those on disk differ from the log.

    Raises:
        LogError: The log does not hold the inputs.
        PlugInError: A controller is not available.
        InputError: A change does not fit, or code has changed since the run.
        ControllerFault: A controller cannot be configured.
    """
    reader = open_log(log)
    read = overview(reader)
    inputs = recorded(read)
    coded, code_changes = with_code(inputs.plan, code)
    plugins = load_plugins(files=coded.included)
    plan = replace(inputs.loop, controllers=coded.loop.controllers)
    plan = with_changed_code(with_arguments(coded, plan, arguments or {}), inputs.loop, plugins)
    plan = with_settings(plan, settings, plugins)
    _offered(reader.path, plan, plugins)
    prepared = PreparedComparison(inputs)
    plan = prepared.of_plan(plan, plugins)
    woken_ns = inputs.log.cycles["woken_ns"]
    messages = MessageComparison(inputs)
    tape = Tape(reader, woken_ns, messages.add_messages)

    run = RecordedRun(inputs, plan, plugins, row=tape.row, messages=messages, prepare=prepared.of_client)
    comparison = Comparison(plan, inputs, lambda: run.controllers)
    result = run.run(comparison.compare_cycle)

    early = comparison.compared < inputs.end
    messages.report_missing((int(woken_ns[comparison.compared - 1]) if comparison.compared else -1) - early)
    # Within a cycle, a difference appears first in a prepared array, then in the command, then in a message.
    firsts = [one for one in (prepared.first, comparison.first, messages.first) if one is not None]
    fault = f"the replay ended: {result.detail or 'its policy ended'}" if early else ""
    return ReplayReport(
        log=str(reader.path),
        robot=inputs.plan.robot,
        cycles=len(inputs.log.cycles),
        compared=comparison.compared,
        last=int(inputs.log.cycles["cycle"][max(comparison.compared, 1) - 1]),
        different=comparison.different,
        first=min(firsts, key=lambda one: one.cycle, default=None),
        joints=comparison.joints(),
        fault=fault,
        stopped="" if fault else inputs.stopped,
        remarks=(
            *read.damage,
            *version_remarks(inputs, plugins),
            *code_remarks(inputs),
            *code_changes,
            *run.remarks,
            *messages.remarks,
        ),
        messages=messages.compared,
        different_messages=messages.different,
        prepared=prepared.compared,
        different_prepared=prepared.different,
        unprepared=prepared.without_request,
    )


def _offered(log: Path, loop: LoopPlan, plugins: PlugIns) -> None:
    """Raise PlugInError with a line for each controller of the log whose type no plug-in offers here."""
    missing = [
        f"{log}: no plug-in offers the type {one.type} of controller {one.name}; install "
        f"{one.distribution or 'its package'}"
        for one in loop.controllers
        if one.type not in plugins.controllers
    ]
    if missing:
        raise PlugInError("\n".join((*missing, *plugins.broken.values())))
