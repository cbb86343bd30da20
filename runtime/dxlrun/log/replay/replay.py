"""Replay: manager, gate and loop of a run on the inputs in its log, compared bit by bit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dxlrun.control.controllers.manager import Manager
from dxlrun.control.controllers.plugins import PlugIns, load_plugins
from dxlrun.control.controllers.topics import TopicLog
from dxlrun.control.gate import Gate
from dxlrun.control.loop import Loop, LoopResult, StopFlag
from dxlrun.control.loop_plan import LoopPlan
from dxlrun.description.modes import COMMAND_INTERFACES
from dxlrun.errors import LogError, counted
from dxlrun.log.reader import read_log
from dxlrun.log.replay.changes import Setting, with_arguments, with_settings
from dxlrun.log.replay.inputs import PlannedCommands, RecordedClock, RecordedHardware, RecordedInbox
from dxlrun.log.replay.numbers import shown_bits
from dxlrun.log.replay.prepared import PreparedComparison, PreparedDifference
from dxlrun.log.replay.published import MessageComparison, MessageDifference
from dxlrun.log.replay.recorded import RecordedInputs, recorded, version_remarks
from dxlrun.run.channels.cycle import CycleLayout, CycleRecord, Floats
from dxlrun.run.channels.events import EventCode, Severity

_COMMANDS = tuple(f"command_{interface}" for interface in COMMAND_INTERFACES)
_GOALS = tuple(f"goal_{interface}" for interface in COMMAND_INTERFACES)
_COMPARED = ("reference", *_COMMANDS, *_GOALS)
"""In the order in which they are computed: what differs first is the cause of the rest."""
_WHAT = {
    **{f"command_{interface}": f"command of the {interface}" for interface in COMMAND_INTERFACES},
    **{
        f"goal_{interface}": f"goal of the {interface}, after the last gate"
        for interface in COMMAND_INTERFACES
    },
}
_Words = NDArray[np.uint64]


@dataclass(frozen=True, slots=True)
class ReplayDifference:
    """One value that is not the same."""

    cycle: int
    time_s: float
    """Of the cycle's wake-up, since the loop's first deadline."""
    what: str
    """`command of the position`, `goal of the velocity ...`, `reference arm_pid/j0/position`, `active`."""
    joint: str | None
    """None: a controller was active in one of the two and not in the other, or a message differs."""
    controller: str | None
    """The one that claims the joint, or commands the reference; None when none does."""
    recorded: str
    """The shortest number with these bits, and the bits where they are not a finite number's."""
    replayed: str


@dataclass(frozen=True, slots=True)
class JointDifferences:
    """In how many cycles one joint's values differ."""

    joint: str
    commands: int
    goals: int
    references: int = 0


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

    @property
    def same(self) -> bool:
        """True when everything that can be compared was, and nothing differs."""
        differ = self.different or self.different_messages or self.different_prepared
        return not differ and not self.fault

    @property
    def sentence(self) -> str:
        """The result in one sentence."""
        cycles = counted(self.compared, "cycle", "cycles")
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


class _Silence:
    """The events of a replay: the recorded ones are in the log."""

    def emit(self, code: EventCode, severity: Severity, source: str, text: str, data: bytes = b"") -> None:
        """Forget it."""


def replay_log(
    log: Path, settings: Sequence[Setting] = (), arguments: Mapping[str, str] | None = None
) -> ReplayReport:
    """Run the controllers of a log on its inputs and compare what they command; changes are made before.

    Raises LogError when the log does not hold the inputs, PlugInError when a controller is not to be had,
    InputError when a change does not fit, ControllerFault when a controller cannot be configured.
    """
    read = read_log(log)
    inputs = recorded(read)
    plugins = load_plugins()
    loop = with_arguments(inputs.plan, inputs.loop, arguments or {})
    loop = with_settings(loop, settings, plugins)
    ended = any(event.code == EventCode.LOOP_STOPPED for event in read.events)
    last_ns = int(inputs.cycles["woken_ns"][-1])
    messages = MessageComparison(read, last_ns, whole=ended and not inputs.stopped)
    prepared = PreparedComparison()
    loop = prepared.of_plan(loop, inputs.commands, plugins)
    comparison, result, refused = _run(inputs, loop, plugins, messages, prepared, read.header.epoch_offset_ns)
    early = comparison.compared < len(inputs.cycles)
    messages.finish(int(inputs.cycles["woken_ns"][max(0, comparison.compared - 1)]) - early)
    return ReplayReport(
        log=str(log),
        robot=inputs.plan.robot,
        cycles=inputs.in_log,
        compared=comparison.compared,
        different=comparison.different,
        first=_first(comparison, messages.first, prepared.first),
        joints=comparison.joints(),
        fault=f"the replay ended: {result.detail or 'its policy was done'}" if early else "",
        stopped="" if early else inputs.stopped,
        remarks=(
            *inputs.remarks,
            *version_remarks(read, inputs.plan.loop, plugins),
            *refused,
            *messages.remarks,
        ),
        messages=messages.compared,
        different_messages=messages.different,
        prepared=prepared.compared,
        different_prepared=prepared.different,
        unprepared=prepared.without_request,
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


def _run(  # noqa: PLR0917  what a loop is made of
    inputs: RecordedInputs,
    plan: LoopPlan,
    plugins: PlugIns,
    messages: MessageComparison,
    prepared: PreparedComparison,
    epoch_offset_ns: int,
) -> tuple[Comparison, LoopResult, tuple[str, ...]]:
    """Put recorded hardware, clock and clients into the loop that runs robots, and run it."""
    names = tuple(joint.name for joint in plan.joints)
    controllers = tuple(controller.name for controller in plan.controllers)
    record = CycleRecord(CycleLayout(names, controllers, plan.references))
    stop, events = StopFlag(), _Silence()
    clock = RecordedClock(inputs.start_ns - plan.period_ns)
    hardware = RecordedHardware(inputs.cycles, inputs.activation, record, clock, stop, ends=inputs.ends)
    taken = PlannedCommands(inputs.commands, str(inputs.log))
    topics = TopicLog(record, messages, epoch_offset_ns)
    manager = Manager(plan, plugins, record, events, clock, commands=taken, topics=topics, kept=inputs.kept)
    inbox = RecordedInbox(inputs.steered, record, lambda taken: prepared.of_client(taken, manager.controller))
    comparison = Comparison(plan, inputs.cycles, inputs.start_ns, manager)
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


class Comparison:
    """The sink of a replayed loop: compares each cycle as it comes; NaN and zero by their bits too."""

    def __init__(
        self,
        plan: LoopPlan,
        cycles: NDArray[np.void],
        start_ns: int,
        manager: Manager,
    ) -> None:
        self.first: ReplayDifference | None = None
        self._plan = plan
        self._manager = manager
        self._cycles = cycles
        self._start_ns = start_ns
        self._recorded: dict[str, _Words] = {
            name: np.ascontiguousarray(cycles[name]).view("<u8") for name in _COMPARED
        }
        self._differs = {name: np.zeros(bits.shape, dtype=np.bool_) for name, bits in self._recorded.items()}
        self._activity = np.zeros(len(cycles), dtype=np.bool_)
        self._index = 0

    @property
    def compared(self) -> int:
        """Number of cycles that were compared."""
        return self._index

    @property
    def different(self) -> int:
        """In how many cycles anything differs."""
        any_of = self._activity.copy()
        for differs in self._differs.values():
            any_of |= differs.any(axis=1)
        return int(np.count_nonzero(any_of))

    def joints(self) -> tuple[JointDifferences, ...]:
        """Return the joints of which anything differs, in the order of rows."""
        differs = self._differs
        commands, goals = (
            np.logical_or.reduce([differs[name] for name in names]).sum(axis=0)
            for names in (_COMMANDS, _GOALS)
        )
        found = (
            JointDifferences(joint.name, int(command), int(goal), self._references(joint.name))
            for joint, command, goal in zip(self._plan.joints, commands, goals, strict=True)
        )
        return tuple(one for one in found if one.commands or one.goals or one.references)

    def _references(self, joint: str) -> int:
        """Return in how many cycles references of this joint differ."""
        places = [at for at, name in enumerate(self._plan.references) if name.split("/")[1] == joint]
        return int(np.count_nonzero(self._differs["reference"][:, places].any(axis=1)))

    def wake(self, cycle: int) -> None:
        """Nothing is exchanged."""

    def begin(self, record: CycleRecord) -> None:
        """Nothing was commanded yet."""

    def append(self, record: CycleRecord) -> None:
        """Compare one finished cycle. Raises LogError when its inputs are not the recorded ones."""
        index = self._index
        row = self._cycles[index]
        if record.cycle == row["cycle"] and record.scheduled_ns != row["scheduled_ns"]:
            raise LogError(
                f"cycle {record.cycle} was due {self._since_start(int(row['scheduled_ns']))} in the run and "
                f"{self._since_start(record.scheduled_ns)} in the replay: a change of the rate in the log is "
                "not the one that was made, or the dxlrun that made the log counts in another way"
            )
        if record.cycle != row["cycle"] or record.period_ns != row["period_ns"]:
            raise LogError(
                f"cycle {int(row['cycle'])} was given a period of {int(row['period_ns'])} ns in the run and "
                f"cycle {record.cycle} {record.period_ns} ns in the replay: the log is damaged, or was made "
                "by a dxlrun whose loop counts in another way"
            )
        active = record.active & 0xFFFFFFFFFFFFFFFF
        if active != int(row["active"]):
            self._activity[index] = True
            self.first = self.first or self._of_activity(index, active)
        for name, values in zip(_COMPARED, _values(record), strict=True):
            bits: _Words = values.view(np.uint64)
            np.not_equal(bits, self._recorded[name][index], out=self._differs[name][index])
            if self.first is None and self._differs[name][index].any():
                self.first = (
                    self._of_reference(index, bits, active)
                    if name == "reference"
                    else self._of_joint(index, name, bits, active)
                )
        self._index += 1

    def _since_start(self, time_ns: int) -> str:
        return f"at {(time_ns - self._start_ns) * 1e-9:.6f} s"

    def _of_activity(self, index: int, active: int) -> ReplayDifference:
        recorded = int(self._cycles["active"][index])
        changed = recorded ^ active
        bit = (changed & -changed).bit_length() - 1
        states = [("active" if mask >> bit & 1 else "not active") for mask in (recorded, active)]
        cycle, time_s = self._when(index)
        plans = self._manager.plans
        # one that the replay could not load has no name here
        name = plans[bit].name if bit < len(plans) else f"number {bit}, loaded in the run"
        return ReplayDifference(cycle, time_s, "active", None, name, *states)

    def _of_joint(self, index: int, name: str, bits: _Words, active: int) -> ReplayDifference:
        row = int(np.argmax(self._differs[name][index]))
        joint = self._plan.joints[row].name
        cycle, time_s = self._when(index)
        both = active | int(self._cycles["active"][index])
        owner = self._owner(joint, both)
        values = [shown_bits(int(words[row])) for words in (self._recorded[name][index], bits)]
        return ReplayDifference(cycle, time_s, _WHAT[name], joint, owner, *values)

    def _of_reference(self, index: int, bits: _Words, active: int) -> ReplayDifference:
        place = int(np.argmax(self._differs["reference"][index]))
        name = self._plan.references[place]
        lower, joint, interface = name.split("/")
        cycle, time_s = self._when(index)
        both = active | int(self._cycles["active"][index])
        uppers = (
            one.name
            for bit, one in enumerate(self._manager.plans)
            if both >> bit & 1 and lower in one.into and joint in one.joints and interface in one.command
        )
        values = [shown_bits(int(words[place])) for words in (self._recorded["reference"][index], bits)]
        return ReplayDifference(cycle, time_s, f"reference {name}", joint, next(uppers, None), *values)

    def cycle_at(self, t_ns: int) -> tuple[int, float]:
        """Return the cycle that woke at this time, -1: before the first one, and its time since the start."""
        index = int(np.searchsorted(self._cycles["woken_ns"], t_ns, side="right")) - 1
        return (int(self._cycles["cycle"][index]) if index >= 0 else -1), (t_ns - self._start_ns) * 1e-9

    def time_s(self, cycle: int) -> float:
        """Return when a cycle woke, since the start."""
        index = int(np.searchsorted(self._cycles["cycle"], cycle))
        return self._when(min(index, len(self._cycles) - 1))[1]

    def _when(self, index: int) -> tuple[int, float]:
        row = self._cycles[index]
        return int(row["cycle"]), (int(row["woken_ns"]) - self._start_ns) * 1e-9

    def _owner(self, joint: str, active: int) -> str | None:
        for bit, controller in enumerate(self._manager.plans):
            if active >> bit & 1 and controller.commands_servos and joint in controller.joints:
                return controller.name
        return None


def _values(record: CycleRecord) -> tuple[Floats, ...]:
    return record.reference, *record.commands.values, *record.goals.values
