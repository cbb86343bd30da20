"""Virtual run: loop, hardware and log of a run in one process, in virtual time with simulated servos."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dxlrun.channels import slot
from dxlrun.channels.commands import CommandRing, Inbox, NoCommands, QueueInbox
from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.event_records import EventRing, EventTotals
from dxlrun.channels.logged_packets import PacketBatch
from dxlrun.channels.ring import Handover, Payload, RecordKind
from dxlrun.channels.slot import SlotWriter
from dxlrun.channels.topic_messages import MessageRing, MessageSink
from dxlrun.compile.simulation import sensed_bodies, simulation_of
from dxlrun.control.context import StopFlag, Unsupervised
from dxlrun.control.controllers.plugin_loading import PlugIns, load_plugins
from dxlrun.control.loop import LoopResult
from dxlrun.control.sampled_sources import (
    ProcessStage,
    SampledSource,
    SourceContext,
    describe_error,
    planned_processes,
)
from dxlrun.errors import DxlrunError, InputError, PortError
from dxlrun.features import stages
from dxlrun.log.ledger_file import open_ledger
from dxlrun.log.part_writer import PartWriter, open_writer
from dxlrun.plan.policy_plan import TORQUE_STAYS
from dxlrun.plan.robot_plan import Plan
from dxlrun.run import texts
from dxlrun.run.assembly import LoopHost, Sinks, assemble
from dxlrun.run.kept_files import KeptFiles, read_states, state_directory
from dxlrun.run.run_log import discard_log, incomplete_log, log_header, new_log
from dxlrun.run.run_summary import RunOptions, RunStatusLine, RunSummary, caught_signals
from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.device.on_links import fix_to_links
from dxlsim.motion.body import SensedBody
from dxlsim.motion.mechanics import Mechanics, plant_of
from dxlsim.virtual_ports import VirtualPorts
from dxlwire.clock import VirtualClock
from dxlwire.packets import PacketLog

if TYPE_CHECKING:
    from rich.console import Console


class VirtualRobot:
    """A robot and its simulated servos in virtual time. Runs of one plan are identical.

    Every bus of the plan is simulated.

    Args:
        plan: The robot.
        plugins: Plug-ins that this process has loaded; None: they are loaded here.
        log: Path of the log; None: no log.
        take_over: The servos may have torque already.
        ledger: Record of the simulated buses' traffic, closed with the log; None: a ledger in memory.
        watch: Called with each record, in the cycle that makes it, as a recorder would receive it.
        kept: Directory of the controllers' kept states; None: they are discarded.
        inbox: Commands for the loop in place of those in `self.inbox`.

    Raises:
        InputError: The plan has a bus that is not `sim`.
    """

    def __init__(
        self,
        plan: Plan,
        plugins: PlugIns | None = None,
        *,
        log: Path | None = None,
        take_over: bool = False,
        ledger: Ledger | None = None,
        watch: Callable[[RecordKind, Payload], None] | None = None,
        kept: Path | None = None,
        inbox: Inbox | None = None,
    ) -> None:
        require_simulated(plan)
        self.plan = plan
        self.clock = VirtualClock()
        self.ledger = Ledger() if ledger is None else ledger
        """All bytes that the simulated servos received and sent."""
        simulated = simulation_of(plan)
        mechanics = Mechanics(0, plant_of(simulated))
        self.buses = tuple(SimulatedBus(config, self.ledger, 0, mechanics) for config in simulated.buses)
        """Simulated buses, in the order of the plan's buses; faults are injected here."""
        if simulated.sensed is not None:
            fix_to_links((one for bus in self.buses for one in bus.devices), mechanics, simulated.sensed)
        if plugins is None:
            plugins = load_plugins(files=plan.included)
        with ExitStack() as opened:
            slots = self._open_sources(plugins, mechanics, opened)
            self.stop = StopFlag()
            self.inbox = QueueInbox()
            """Commands put here are read at the start of a cycle."""
            self.result: LoopResult | None = None
            self.messages = 0
            self.log_error: str | None = None
            """Reason why the log is incomplete."""
            states = read_states(plan, kept)
            header = log_header(plan, 0, virtual=True, kept=states) if log else None
            self._writer = open_writer(log, header, plan.recording) if log and header else None
            self._kept = KeptFiles(kept) if kept else None

            def handle_record(kind: RecordKind, payload: Payload) -> None:
                if self._writer:
                    self._writer.write_record(kind, payload)
                    if kind == RecordKind.CYCLE and isinstance(self._writer, PartWriter):
                        self._writer.split_if_due()
                if watch:
                    watch(kind, payload)
                if self._kept:
                    self._kept.process_record(kind, payload)

            to_log = Handover(handle_record)
            self._events = EventRing(to_log, self.clock)
            self._events.goals.planned = plan.loop.origins
            self.sinks = Sinks(
                to_log,
                PacketBatch(to_log) if log else PacketLog(),
                self._events,
                CommandRing(to_log) if log else NoCommands(),
                messages=MessageRing(to_log) if log or kept or watch else MessageSink(),
            )
            host = LoopHost(
                ports=VirtualPorts(self.clock, self.buses),
                clock=self.clock,
                sinks=self.sinks,
                supervision=Unsupervised(self.stop),
                inbox=self.inbox if inbox is None else inbox,
                slots=slots,
            )
            self.robot = assemble(plan, plugins, host, take_over=take_over, kept=states)
            # From here on, the end of the run closes the sources.
            self._opened = opened.pop_all()

    def _open_sources(
        self, plugins: PlugIns, mechanics: Mechanics, opened: ExitStack
    ) -> dict[str, list[memoryview]]:
        """Open the sources of features, and schedule their samples; return the slots. Raises PortError."""
        bodies = sensed_bodies(self.plan)
        body = None if bodies is None else SensedBody(bodies, mechanics, self.clock.now_ns)
        slots: dict[str, list[memoryview]] = {}
        self.drivers: dict[str, Any] = {}
        """Driver of each source, as its plug-in made it, by the source's name."""
        for planned in planned_processes(self.plan.loop):
            process, memory = planned.process, slot.private(planned.process.values)
            slots.setdefault(planned.feature.name, []).append(memory)
            own_body = body if process.has_body else None
            context = SourceContext(plugins, SlotWriter(memory), self.clock.now_ns, own_body)
            sampled = planned.stage.build(process.plan, context)
            self.drivers[process.source] = sampled.driver
            try:
                sampled.open_first()
            # Any error of a driver becomes a sentence.
            except Exception as error:
                raise PortError(f"{process.title} cannot be opened: {describe_error(error)}") from error
            opened.callback(sampled.close)
            self._sample(sampled, process.period_ns, self.clock.now_ns())
        return slots

    def _sample(self, sampled: SampledSource, period_ns: int, due_ns: int) -> None:
        """Schedule a sample, and one in each later period."""

        def sample() -> None:
            # Bytes on the wire must take effect at their own time, before the sample.
            for bus in self.buses:
                bus.advance_to(due_ns)
            sampled.sample()
            self._sample(sampled, period_ns, due_ns + period_ns)

        self.clock.call_at(due_ns, sample)

    @property
    def cycles(self) -> int:
        """Number of cycles."""
        return self.sinks.ran

    @property
    def skipped(self) -> int:
        """Number of skipped periods."""
        return self.sinks.skipped

    @property
    def record(self) -> CycleRecord:
        """Record of the last cycle."""
        return self.robot.record

    @property
    def failures(self) -> tuple[str, ...]:
        """Servos and devices that could not be switched off at the end, one sentence each."""
        return self.robot.failures

    @property
    def unkept(self) -> tuple[str, ...]:
        """Kept states that could not be written to a file, one sentence each."""
        return self._kept.sentences if self._kept else ()

    @property
    def events(self) -> EventTotals:
        """Totals of the run's events."""
        return self._events.totals

    def run(self) -> LoopResult:
        """Set up, run to the plan's end or a fault, switch torque off unless a policy holds, close the log.

        Raises StartUpError; a controller's fault is in the result.
        """
        try:
            self.result = self.robot.run()
        except DxlrunError as error:
            self.sinks.events.emit_event("loop", texts.start_refused(error.sentences))
            raise
        finally:
            self.sinks.packets.commit_packets()
            self._opened.close()
            if self._writer:
                summary = self._writer.close()
                self.messages, self.log_error = summary.messages, summary.error
            self.ledger.close()
        return self.result


def require_simulated(plan: Plan) -> None:
    """Raise InputError when a bus or a sensor of the plan is real, to which virtual time does not apply."""
    real = [bus.name for bus in plan.buses if bus.port != "sim"]
    if real:
        raise InputError(
            f"--virtual needs simulated servos, and bus {', '.join(real)} has a real port; "
            "give the argument port:=sim"
        )
    for feature, stage in stages(ProcessStage, plan.features):
        if why := stage.refuse_virtual_time(plan.feature_plans.get(feature.name, b"")):
            raise InputError(why)


def _stop(stop: StopFlag) -> None:
    """Request a normal stop at the first signal; raise KeyboardInterrupt at the second."""
    if stop.requested:
        raise KeyboardInterrupt
    stop.request()


def run_virtual(plan: Plan, plugins: PlugIns, options: RunOptions, out: Console) -> RunSummary:
    """Run a plan in virtual time for the command line; the log has the times of the virtual clock."""
    log = new_log(plan.recording, plan.robot) if options.record else None
    try:
        # A run at the command line needs no ledger in memory, which would grow without bound.
        ledger = open_ledger(options.ledger)
        kept = state_directory(plan)
        robot = VirtualRobot(plan, plugins, log=log, take_over=options.take_over, ledger=ledger, kept=kept)
    except BaseException:
        if log:
            discard_log(log)
        raise
    refused: tuple[str, ...] = ()
    with caught_signals(partial(_stop, robot.stop)), out.status(f"{plan.robot}: starting") as status:
        robot.sinks.progress = RunStatusLine(plan, status, virtual=True).ran
        try:
            result = robot.run()
        except DxlrunError as error:
            if options.debug:
                sys.stderr.write(traceback.format_exc())
            result, refused = LoopResult(0, 0, "fault"), error.sentences
        except KeyboardInterrupt:
            result = LoopResult(robot.cycles, robot.skipped, "stopped")
    incomplete = [ledger.error] if ledger.error else []
    if robot.log_error:
        incomplete.append(incomplete_log(robot.log_error))
    sentences = (*refused, *((result.detail,) if result.detail else ()), *robot.failures, *incomplete)
    interrupted = robot.stop.requested and not sentences
    return RunSummary(
        exit_code=130 if interrupted else 0 if result.reason == "ended" and not sentences else 1,
        reason="interrupted" if interrupted else result.reason,
        cycles=result.cycles,
        skipped=result.skipped,
        sentences=sentences,
        remarks=(*((TORQUE_STAYS,) if result.last == "hold" else ()), *robot.unkept),
        log=str(log) if log and log.exists() else None,
        messages=robot.messages,
        invalid=result.invalid,
        paused=result.paused,
        outside=result.outside,
        virtual=True,
        events=robot.events,
    )
