"""Replay: run the controllers of a log again on the inputs in it, and compare what they command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dxlrun.channels.events import EventCode
from dxlrun.control.controllers.plugins import PlugIns, load_plugins
from dxlrun.errors import PlugInError, counted
from dxlrun.log.reader import Log, LogReader, open_log
from dxlrun.plan.loop_plan import LoopPlan
from dxlrun_analysis.replay.changes import Setting, with_arguments, with_settings
from dxlrun_analysis.replay.comparison import Comparison, JointDifferences, ReplayDifference
from dxlrun_analysis.replay.part import PartReplay
from dxlrun_analysis.replay.prepared import PreparedComparison, PreparedDifference
from dxlrun_analysis.replay.published import MessageComparison, MessageDifference
from dxlrun_analysis.replay.recorded import RecordedInputs, code_remarks, recorded, version_remarks
from dxlrun_analysis.replay.tape import Overview, Tape, overview


@dataclass(frozen=True, slots=True)
class ReplayedPart:
    """Cycles that were replayed one after the other."""

    first: int
    """Number of the first cycle, and of the last."""
    last: int
    snapshot: int
    """Number of the cycle whose snapshots it began with; -1: with the activation."""


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """The result of `dxlrun replay`."""

    log: str
    robot: str
    cycles: int
    """That the log has."""
    compared: int
    different: int
    """Cycles in which anything differs."""
    first: ReplayDifference | None
    joints: tuple[JointDifferences, ...]
    """Those of which anything differs."""
    fault: str
    """Why the replay ended before the run did; empty when it did not."""
    stopped: str
    """Why not all cycles were compared; empty when they were, or when `fault` is the reason."""
    remarks: tuple[str, ...]
    """Other versions, damage of the log."""
    messages: int = 0
    """Messages of topics that were compared, or are in one of the two only."""
    different_messages: int = 0
    prepared: int = 0
    """Commands that were prepared again."""
    different_prepared: int = 0
    unprepared: int = 0
    """Commands whose request the log does not have: it was too long, or its dxlrun is an older one."""

    parts: tuple[ReplayedPart, ...] = ()
    """What was replayed."""

    @property
    def same(self) -> bool:
        """True when everything that can be compared was, and nothing differs."""
        differ = self.different or self.different_messages or self.different_prepared
        return not differ and not self.fault

    @property
    def sentence(self) -> str:
        """The result in one sentence."""
        cycles = counted(self.compared, "cycle", "cycles")
        if self.compared < self.cycles or any(part.snapshot >= 0 for part in self.parts):
            spans = " and ".join(f"{part.first} to {part.last}" for part in self.parts)
            cycles = f"cycles {spans} ({self.compared} of {self.cycles})"
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
    log: Path, settings: Sequence[Setting] = (), arguments: Mapping[str, str] | None = None
) -> ReplayReport:
    """Run the controllers of a log on its inputs and compare what they command; changes are made before.

    Memory does not grow with packets, states and messages of the log. Raises LogError when the log does not
    hold the inputs, PlugInError when a controller is not to be had, InputError when a change does not fit,
    ControllerFault when a controller cannot be configured.
    """
    reader = open_log(log)
    seen = overview(reader)
    return replay_parts(reader, seen, recorded(seen), settings, arguments or {})


def replay_parts(
    reader: LogReader,
    seen: Overview,
    inputs: RecordedInputs,
    settings: Sequence[Setting] = (),
    arguments: Mapping[str, str] | None = None,
) -> ReplayReport:
    """Replay the parts of a log that can be, as `replay_log`."""
    read, plugins = seen.log, load_plugins()
    loop = with_arguments(inputs.plan, inputs.loop, arguments or {})
    loop = with_settings(loop, settings, plugins)
    _offered(reader.path, loop, plugins)
    messages = MessageComparison(read)
    prepared = PreparedComparison()
    loop = prepared.of_plan(loop, inputs.commands, plugins)
    tape = Tape(reader, inputs.cycles["woken_ns"], messages.feed)
    comparison = Comparison(loop, inputs.cycles, inputs.start_ns)
    playing = PartReplay(
        inputs=inputs,
        plan=loop,
        plugins=plugins,
        messages=messages,
        prepared=prepared,
        comparison=comparison,
        tape=tape,
        epoch_offset_ns=read.header.epoch_offset_ns,
        ended=_ends_in_order(read),
    )
    fault = ""
    replayed: list[ReplayedPart] = []
    for part in inputs.parts:
        result = playing.run(part)
        end = part.first + comparison.compared_of(part)
        number = inputs.cycles["cycle"]
        if end > part.first:
            start = -1 if part.start is None else part.start.cycle
            replayed.append(ReplayedPart(int(number[part.first]), int(number[end - 1]), start))
        if end < part.end:
            fault = f"the replay ended: {result.detail or 'its policy was done'}"
            break
    return ReplayReport(
        log=str(reader.path),
        robot=inputs.plan.robot,
        cycles=len(inputs.cycles),
        compared=comparison.compared,
        different=comparison.different,
        first=_first(comparison, messages.first, prepared.first),
        joints=comparison.joints(),
        fault=fault,
        stopped="" if fault else inputs.stopped,
        remarks=(
            *inputs.remarks,
            *version_remarks(read, inputs.plan.loop, plugins),
            *code_remarks(read, inputs.plan.loop),
            *playing.remarks,
            *messages.remarks,
        ),
        messages=messages.compared,
        different_messages=messages.different,
        prepared=prepared.compared,
        different_prepared=prepared.different,
        unprepared=prepared.without_request,
        parts=tuple(replayed),
    )


def _offered(log: Path, loop: LoopPlan, plugins: PlugIns) -> None:
    """Raise PlugInError with a line for each controller of the log whose type no plug-in offers here."""
    missing = [
        f"{log}: no plug-in offers the type {one.type} of controller {one.name}; the run had it from "
        f"{one.distribution or 'another package'}: install that"
        for one in loop.controllers
        if one.type not in plugins.controllers
    ]
    if missing:
        raise PlugInError("\n".join((*missing, *plugins.broken.values())))


def _ends_in_order(log: Log) -> bool:
    """Return whether the last cycle of the log is that of a run which ended in order."""
    last = int(log.cycles["cycle"][-1])
    return all(one.last < last for one in log.left_out) and any(
        event.code == EventCode.LOOP_STOPPED for event in log.events
    )


def _first(
    comparison: Comparison, message: MessageDifference | None, prepared: PreparedDifference | None
) -> ReplayDifference | None:
    """Return what differs first: of one cycle a prepared array, then the command, then a message about it."""
    first = comparison.first
    if prepared is not None and (first is None or prepared.cycle <= first.cycle):
        time_s = comparison.time_s(prepared.cycle)
        first = ReplayDifference(
            prepared.cycle,
            time_s,
            prepared.what,
            None,
            prepared.controller,
            prepared.recorded,
            prepared.replayed,
        )
    if message is None:
        return first
    cycle, time_s = comparison.cycle_at(message.t_ns)
    if first is not None and first.cycle <= cycle:
        return first
    what = f"message of {message.topic}" + (f": {message.field}" if message.field else "")
    return ReplayDifference(cycle, time_s, what, None, None, message.recorded, message.replayed)
