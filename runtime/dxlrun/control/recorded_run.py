"""Recorded run: run a loop again with the clock, servo states and client commands of a log, without servos.

A replay replaces only these interfaces of the loop.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dxlrun.channels.answers import Answer, Refusal
from dxlrun.channels.commands import ClientCommand, CommandMessage, TakenCommand
from dxlrun.channels.cycle import CycleRecord, States
from dxlrun.channels.event_records import EventBody, EventCode
from dxlrun.channels.kept import KeptStates
from dxlrun.channels.topic_messages import MessageSink
from dxlrun.contract.controller import Controller
from dxlrun.control.context import ControlContext, StopFlag, Unsupervised
from dxlrun.control.controllers.manager import Manager
from dxlrun.control.controllers.plugin_loading import PlugIns
from dxlrun.control.controllers.published_topics import TopicLog
from dxlrun.control.loop import ControlLoop, LoopResult
from dxlrun.errors import LogError, PortError
from dxlrun.features import find_installed
from dxlrun.log.log_reader import UNREADABLE, Log
from dxlrun.log.schemas import KEPT_ATTACHMENT
from dxlrun.plan.loop_plan import ControllerPlan, LoopPlan, ServoLimit
from dxlwire.modes import COMMAND_INTERFACES

_STATES = tuple(field.name for field in fields(States) if field.name != "motion")  # a view of three others


class RunInputs(msgspec.Struct, frozen=True, eq=False):
    """Inputs of one recorded run, taken from its log."""

    log: Log  # Without packets and topics; only the scalars of cycles
    loop: LoopPlan
    """The loop's plan, including the planned commands that cycles executed. The recording decides when it
    ends, skips periods and begins a policy."""
    activation: np.void  # States and goals when the controllers were activated
    start_ns: int  # Deadline of cycle 0
    steered: tuple[ClientCommand, ...]  # Commands of clients
    end: int  # Number of cycles that can be replayed, at least one
    ends: int  # Index of the first cycle of a policy, from which on controllers are not active
    kept: KeptStates  # States of earlier runs that the controllers started with


def kept_states_of(log: Log) -> KeptStates:
    """Return the kept states, from earlier runs, that the controllers started with; empty for older logs.

    Raises: LogError: The attachment cannot be read.
    """
    data = log.attachments.get(KEPT_ATTACHMENT)
    try:
        return KeptStates() if data is None else msgspec.json.decode(data, type=KeptStates)
    except UNREADABLE as error:
        raise LogError(f"{log.path}: {KEPT_ATTACHMENT} in the log cannot be read: {error}") from error


class RecordedClock:
    """Clock that returns the recorded times instead of the machine's."""

    __slots__ = ("_now_ns", "wake_ns")

    def __init__(self, now_ns: int) -> None:
        self._now_ns = now_ns
        self.wake_ns = now_ns  # When the next wait ends

    def now_ns(self) -> int:
        """Return the recorded time of the current point in the cycle, ns."""
        return self._now_ns

    def wait_until(self, deadline_ns: int) -> int:
        """Ignore the deadline, set the clock to the recorded wake-up time and return that, ns."""
        self._now_ns = self.wake_ns
        return self._now_ns

    def set_time(self, now_ns: int) -> None:
        """Set the recorded time that `now_ns` returns, ns."""
        self._now_ns = now_ns


class RecordedHardware:
    """Hardware with the recorded servo states, bit for bit. Goals are ignored; see `contract.hardware`.

    Each write moves the clock to the deadline of the next recorded cycle, so the loop skips the same periods
    as the run. The loop is stopped before cycle `inputs.ends`, where the policy begins. After the last cycle,
    `idle` raises PortError.

    Args:
        inputs: The inputs of the run.
        row: Returns a recorded cycle of the log by its index.
        record: Receives the recorded states of each cycle.
        clock: The clock that the loop uses.
        stop: Flag set to stop the loop before cycle `inputs.ends`.
    """

    def __init__(
        self,
        inputs: RunInputs,
        row: Callable[[int], np.void],
        record: CycleRecord,
        clock: RecordedClock,
        stop: StopFlag,
    ) -> None:
        self._inputs = inputs
        self._row = row
        self._record = record
        self._clock = clock
        self._stop = stop
        self._outside = len(inputs.loop.sources)  # Devices and sensors; they precede controllers
        self._outside_states = sum(len(one.states) for one in inputs.loop.sources)
        self.index = 0  # Index of the replayed cycle
        self.servo_limits: Mapping[int, Sequence[ServoLimit]] = {}
        """Limits in the servos' registers by row of the joint, from the log's events up to this cycle."""
        self._limit_events = deque(_read_limits(inputs))

    def start(self, engaging: Callable[[], None] = lambda: None) -> None:
        """Copy the recorded states and goals of the controllers' activation into the record."""
        record, activation = self._record, self._inputs.activation
        for name in _STATES:
            np.copyto(getattr(record.states, name), activation[name])
        self._take_sources(activation)
        for interface in COMMAND_INTERFACES:
            np.copyto(getattr(record.goals, interface), activation[f"goal_{interface}"])
        self._take_limits(int(self._row(0)["woken_ns"]))

    def _take_limits(self, until_ns: int) -> None:
        while self._limit_events and self._limit_events[0][0] <= until_ns:
            _, row, limits = self._limit_events.popleft()
            self.servo_limits = {**self.servo_limits, row: limits}

    def _take_sources(self, row: np.void) -> None:
        """Copy the recorded states of devices and sensors.

        Controllers compute the states they provide again.
        """
        sources, states, count = self._record.sources, self._outside_states, self._outside
        np.copyto(sources.values[:states], row["source_state"][:states])
        np.copyto(sources.valid[:count], row["source_valid"][:count])
        np.copyto(sources.age_ns[:count], row["source_age_ns"][:count])

    def idle(self, until_ns: int, time_ns: int) -> None:
        """Set the clock's next wake-up to that of the log. Raises PortError after the last recorded cycle."""
        if self.index == self._inputs.end:
            raise PortError("the log ends")
        self._clock.wake_ns = int(self._inputs.log.cycles["woken_ns"][self.index])

    def read_states(self) -> None:
        """Copy the recorded states of this cycle into the record."""
        row = self.recorded()
        for name in _STATES:
            np.copyto(getattr(self._record.states, name), row[name])
        self._take_sources(row)
        self._clock.set_time(int(row["read_ns"]))
        self._take_limits(int(row["updated_ns"]))

    def recorded(self) -> np.void:
        """Return the log's row of the current cycle."""
        return self._row(self.index)

    def write_goals(self) -> None:
        """Ignore the goals, and move the clock to the deadline of the next recorded cycle."""
        following, cycles = self.index + 1, self._inputs.log.cycles
        if following < self._inputs.end:
            self._clock.set_time(int(cycles["scheduled_ns"][following]))
        else:
            self._clock.set_time(int(cycles["written_ns"][self.index]))
        if following == self._inputs.ends:
            self._stop.request()

    def next(self) -> None:
        """Advance to the next recorded cycle, after the current one was compared."""
        self.index += 1

    def set_modes(self, modes: NDArray[np.uint8]) -> None:
        """Do nothing: the recorded states have the modes."""

    def write_register(
        self, row: int, item: str, value: int, done: Callable[[str, int | None], None]
    ) -> None:
        """Do nothing: the recorded states have the result."""

    def read_register(self, row: int, item: str, done: Callable[[str, int | None], None]) -> None:
        """Do nothing: the answer does not affect controllers."""

    def switch_torque(self, row: int, on: bool, done: Callable[[str], None]) -> None:
        """Do nothing: the recorded states have the torque."""

    def follow_goals(self, rows: Sequence[int]) -> None:
        """Do nothing: the recorded states have the positions."""

    def reboot_servo(self, row: int, done: Callable[[str], None]) -> None:
        """Do nothing: the recorded states have the result of the reboot."""

    def limit_torque(self, fraction: float) -> None:
        """Do nothing: the recorded states have the positions under this limit."""

    def stop(self) -> tuple[str, ...]:
        """Do nothing: no servo has torque."""
        return ()

    def leave_torque_on(self) -> None:
        """Do nothing: no servo holds."""


def _read_limits(inputs: RunInputs) -> Iterator[tuple[int, int, Sequence[ServoLimit]]]:
    """Yield time (ns), joint row and register limits of each event in the log that reports servo limits."""
    rows = {joint.name: row for row, joint in enumerate(inputs.loop.joints)}
    for event in inputs.log.events:
        if event.code == EventCode.SERVO_LIMITS and event.source in rows:
            with suppress(*UNREADABLE):
                limits = msgspec.json.decode(event.data, type=tuple[ServoLimit, ...])
                yield event.t_ns, rows[event.source], limits


class RecordedInbox:
    """Inbox that returns the commands that clients sent in the recorded run, in the same cycles.

    `remarks` has a sentence for each command whose acceptance differs between run and replay.

    Args:
        steered: Commands of clients, in the order of the run.
        record: The cycle's record.
        prepared: Returns the data of a recorded command, prepared again for the replay.
    """

    def __init__(
        self,
        steered: Iterable[ClientCommand],
        record: CycleRecord,
        prepared: Callable[[TakenCommand], bytes],
    ) -> None:
        self.remarks: list[str] = []
        self._steered = tuple(steered)
        self._answered: set[int] = set()
        self._record = record
        self._prepared = prepared
        self._by_cycle: dict[int, list[tuple[int, TakenCommand]]] = {}
        for number, one in enumerate(self._steered):
            self._by_cycle.setdefault(one.command.cycle, []).append((number, one.command))

    def drain_commands(self) -> Sequence[CommandMessage]:
        """Return the commands that this cycle executed in the recorded run."""
        return [
            CommandMessage(
                number, then.controller, then.kind, self._prepared(then), then.origin, then.lease_ns
            )
            for number, then in self._by_cycle.get(self._record.cycle, ())
        ]

    def answer_command(self, number: int, answer: Answer) -> None:
        """Note a remark if the first answer accepts a command that was refused in the run, or vice versa."""
        if number in self._answered:
            return  # the late answer of a switch follows from states, which are compared anyway
        self._answered.add(number)
        then = self._steered[number]
        refusal = answer.text if isinstance(answer, Refusal) else ""
        if bool(refusal) == bool(then.refusal):
            return
        command = then.command
        what = f"{command.kind} for {command.controller or 'the loop'} in cycle {command.cycle}"
        self.remarks.append(
            f"{what} was {_outcome(then.refusal)} in the run and is {_outcome(refusal)} in the replay"
        )


def _outcome(refusal: str) -> str:
    return f"refused ({refusal})" if refusal else "done"


class PlannedCommands:
    """Command log that checks that the replay executes each planned command in the same cycle as the run."""

    def __init__(self, commands: Iterable[TakenCommand], log: str) -> None:
        self._log = log
        self._then: Collection[tuple[int, str, str]] = {
            (one.cycle, one.controller, one.kind) for one in commands if one.planned >= 0
        }

    def record_command(self, command: TakenCommand) -> None:
        """Check one executed command. Raises LogError if the run did not execute it in this cycle."""
        if command.planned >= 0 and (command.cycle, command.controller, command.kind) not in self._then:
            raise LogError(
                f"{self._log} is damaged: cycle {command.cycle} lacks the planned {command.kind} for "
                f"{command.controller}"
            )


class _NoEvents:
    """Event sink that drops the events of a replay; the log has the original ones."""

    def emit_event(self, source: str, event: EventBody, data: bytes = b"") -> None:
        """Drop an event."""


Compare = Callable[[CycleRecord, np.void, int], None]
"""Function called after each replayed cycle with its record, the recorded cycle and that cycle's index."""


@dataclass(frozen=True, slots=True)
class _ComparingSink:
    """Cycle sink that passes each replayed cycle, with the recorded one, to the function `compare`."""

    hardware: RecordedHardware
    compare: Compare

    def wake(self, cycle: int) -> None:
        """Do nothing: no packets are exchanged."""

    def append_activation(self, record: CycleRecord) -> None:
        """Do nothing: commands follow in the first cycle."""

    def append_cycle(self, record: CycleRecord) -> None:
        """Compare a finished cycle with the recorded one, and advance the hardware to the next."""
        self.compare(record, self.hardware.recorded(), self.hardware.index)
        self.hardware.next()


class RecordedRun:
    """Runs a loop's controllers again on the inputs of a recorded run.

    Args:
        inputs: The inputs of the run.
        plan: Plan to run: that of the recorded run, possibly changed.
        plugins: Installed controller types.
        row: Returns a cycle of the log by its index.
        messages: Destination of the controllers' messages.
        prepare: Returns the data of a client's command. Its arguments are the command and a function that
            returns a controller by its name.
    """

    def __init__(
        self,
        inputs: RunInputs,
        plan: LoopPlan,
        plugins: PlugIns,
        *,
        row: Callable[[int], np.void],
        messages: MessageSink,
        prepare: Callable[[TakenCommand, Callable[[str], Controller[Any] | None]], bytes],
    ) -> None:
        features = find_installed(plan.features)
        self._missing = [
            f"the run had {one.name} of {one.distribution}; it is not installed here, so its monitoring is "
            "not replayed"
            for one in plan.features
            if one.name not in {each.name for each in features}
        ]
        plan = replace(plan, features=features)
        self._row = row
        record, stop = CycleRecord(plan.layout), StopFlag()
        clock = RecordedClock(inputs.start_ns - plan.period_ns)
        self._hardware = RecordedHardware(inputs, row, record, clock, stop)
        self._inbox = RecordedInbox(
            inputs.steered, record, lambda taken: prepare(taken, self._manager.controller)
        )
        self._context = ControlContext(
            plan=plan,
            record=record,
            clock=clock,
            hardware=self._hardware,
            events=_NoEvents(),
            command_log=PlannedCommands(inputs.log.commands, str(inputs.log.path)),
            inbox=self._inbox,
            supervision=Unsupervised(stop),
        )
        topics = TopicLog(record, messages, inputs.log.header.epoch_offset_ns)
        self._manager = Manager(self._context, plugins, topics=topics, kept=inputs.kept)

    @property
    def controllers(self) -> tuple[ControllerPlan, ...]:
        """Plans of all controllers; the index is the controller's bit in the record's masks."""
        return self._manager.plans

    @property
    def remarks(self) -> Sequence[str]:
        """Sentences about features that are not installed and commands accepted in only one of the runs."""
        return [*self._missing, *self._inbox.remarks]

    def run(self, compare: Compare) -> LoopResult:
        """Replay all recorded cycles, and pass each to `compare` with the recorded one.

        Raises:
            LogError: The log is damaged.
            ControllerFault: A controller cannot be configured.
        """
        loop = ControlLoop(self._context, self._manager, _ComparingSink(self._hardware, compare))
        self._row(0)  # position the log, so that messages before the first cycle are found
        self._manager.configure()
        self._hardware.start()
        return loop.run()
