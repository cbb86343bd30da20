"""Supervisor: the process in this terminal, which starts the processes of a run, ends them, and sums up."""

from __future__ import annotations

import os
import select
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from msgspec.structs import replace

from dxlrun.channels import child_processes
from dxlrun.channels.child_processes import (
    END_TIMEOUT_S,
    Child,
    Cut,
    Failed,
    Finish,
    LateMetadata,
    LineLost,
    LineReturned,
    Listening,
    LoopRuns,
    RunMemory,
    Stop,
)
from dxlrun.channels.commands import LOOP, OWN_ORIGIN, CommandMessage
from dxlrun.channels.heartbeat import GatewayAvailability, Heartbeat, Phase
from dxlrun.channels.kept import KeptStates
from dxlrun.channels.mailbox import MailboxWriter
from dxlrun.channels.shared_memory import mapped
from dxlrun.channels.slot import SlotState, SlotWriter
from dxlrun.control.realtime_grants import Grant
from dxlrun.control.sampled_sources import PlannedProcess, planned_processes
from dxlrun.errors import ProcessFault, counted
from dxlrun.log.schemas import FAILURES_NAME, CycleSpan, LogClosed, epoch_offset_ns
from dxlrun.output.terminal import show_parts
from dxlrun.plan.machine_load import MachineLoad
from dxlrun.plan.robot_plan import Plan
from dxlrun.run import source_process, texts
from dxlrun.run.guardian import Ended, GuardianJob, GuardianMessage, LoopOutcome, SafeStop, Started
from dxlrun.run.kept_files import KeptFiles, KeptStateWriter, read_states, state_directory
from dxlrun.run.process_watch import (
    GUARDIAN_TIMEOUT_NS,
    URGENT_TIMEOUT_NS,
    Duty,
    SignsOfLife,
    WatchedProcess,
    duty_of,
    loop_timeout_ns,
)
from dxlrun.run.run_log import discard_log, incomplete_log, log_header, new_log
from dxlrun.run.run_processes import (
    GatewayMessage,
    RecorderMessage,
    SourceMessage,
    create_memory,
    guardian_job,
    loop_grants,
    loop_outcome,
    start_gateway,
    start_guardian,
    start_recorder,
    start_simulated_buses,
    start_source,
)
from dxlrun.run.run_summary import (
    RunOptions,
    RunStatusLine,
    RunSummary,
    caught_signals,
    granted_text,
    refusals,
    show_grants,
)
from dxlsim.messages import SimulationMessage
from dxlwire.port.ports import put_in_place, set_aside
from dxlwire.port.serial_open import let_go

if TYPE_CHECKING:
    from rich.console import Console

# s; longest wait for a message of the guardian. Each turn is also a heartbeat: two must take less than
# HALTED_NS.
_POLL_S = 0.1
_RESTART_S = 2.0
"""Delay between the end of a source's process and its restart."""
_LOOK_NS = 100_000_000
"""Upper limit of the time that one check adds to a standstill: while this process was not running, the
other may not have run either."""
_GONE_POLL_S = 0.02
"""Polling interval for the guardian after the loop has exited."""


@dataclass(slots=True)
class _SourceProcess:
    """Process of a feature, which is restarted after an unexpected exit."""

    plan: Plan
    planned: PlannedProcess
    memory: RunMemory
    child: Child[SourceMessage] | None
    restart_s: float = 0.0
    """Time of the restart; valid only without a running process."""

    def supervise_process(self) -> None:
        """Report the exit of the process in its slot, for the loop; restart the process when due."""
        if self.child is None:
            if time.monotonic() >= self.restart_s:
                self.restart_s = time.monotonic() + _RESTART_S
                # The system cannot create a process now; try again later.
                with suppress(OSError):
                    self.child = start_source(self.plan, self.planned, self.memory, restarted=True)
        elif self.child.exited():
            self.child.kill()
            code = self.child.process.returncode
            self.child = None
            self.restart_s = time.monotonic() + _RESTART_S
            how = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
            slots = self.memory.slots[self.planned.feature.name]
            writer = SlotWriter(mapped(slots[self.planned.index]))
            writer.write_state(SlotState.ENDED, f"its process exited ({how}) and is restarted")

    def end_process(self) -> None:
        """Give the process time to close its device, then kill it."""
        if self.child is None:
            return
        self.child.process.terminate()
        self.child.exited(source_process.END_S)
        self.child.kill()
        self.child = None


class _Run:
    """Started processes of one run, and their results."""

    def __init__(
        self,
        plan: Plan,
        options: RunOptions,
        memory: RunMemory,
        out: Console,
        kept: KeptStates | None = None,
    ) -> None:
        """`kept`: states that controllers kept in earlier runs."""
        self.plan = plan
        self.options = options
        self.memory = memory
        self.out = out
        self.kept = kept or KeptStates()
        self.offset_ns = epoch_offset_ns()
        """Wall time minus the run's clock."""
        self.simulation: Child[SimulationMessage] | None = None
        self.recorder: Child[RecorderMessage] | None = None
        self.guardian: Child[GuardianMessage] | None = None
        self.gateway: Child[GatewayMessage] | None = None
        self.sources: list[_SourceProcess] = []
        self.writer: KeptStateWriter | None = None
        self.socket: Path | None = None
        """Socket of the gateway; None before it listens."""
        self.remarks: list[str] = []
        self.job: GuardianJob | None = None
        self.loop: int | None = None
        """pidfd of the loop's process; None before its start and after its exit was seen."""
        self.loop_signs: SignsOfLife | None = None
        """None before the start of the loop."""
        self.log: Path | None = None
        self.sentences: list[str] = []
        self.ended: Ended | None = None
        """Last message of the guardian."""
        self.messages = 0
        self.closed: LogClosed | None = None
        """Last message of the recorder; None without a recorder, or after its early end."""
        self.guardian_grants: tuple[Grant, ...] = ()
        self.grants: tuple[Grant, ...] = ()
        """Grants of the operating system; empty before the loop runs."""
        self.signals = 0
        """Number of SIGINT and SIGTERM: the first requests a normal stop, the second cuts torque."""
        self.steerable = options.gateway and plan.gateway
        """False without a gateway, and after the gateway has ended."""
        self.held = self.steerable and (not plan.simulated or bool(options.listen))
        """True while the loop is paused until the gateway responds, so that a client can stop the robot
        before it moves."""

    @property
    def steering(self) -> GatewayAvailability:
        """State of the gateway, as other processes see it."""
        if not self.steerable:
            return GatewayAvailability.IMPOSSIBLE
        return GatewayAvailability.AWAITED if self.socket is None else GatewayAvailability.POSSIBLE

    def count_signal(self) -> None:
        """Count a signal."""
        self.signals += 1

    def start_processes(self, show: Callable[[str], None]) -> Child[GuardianMessage]:
        """Start all processes in sequence, and return the guardian; raises PortError or ProcessFault.

        `show` is called with what is starting: on a busy machine each process takes seconds.
        """
        if self.options.record:
            self.log = new_log(self.plan.recording, self.plan.robot)
        sockets: dict[str, int] = {}
        if self.plan.simulated:
            show("simulated servos")
            self.simulation, sockets = start_simulated_buses(self.plan, self.options.ledger, self.memory)
        for planned in planned_processes(self.plan.loop):
            child = start_source(self.plan, planned, self.memory)
            self.sources.append(_SourceProcess(self.plan, planned, self.memory, child))
        if self.log:
            header = log_header(self.plan, self.offset_ns, virtual=False, kept=self.kept)
            self.recorder = start_recorder(self.log, header, self.memory, self.plan)
        self.writer = KeptStateWriter(self.memory.messages, KeptFiles(state_directory(self.plan)))
        self.writer.start()
        show("recorder and sensors")
        for each in self.sources:
            if each.child is not None:
                each.child.ready()
        self.post_pause()
        others = [child.channel.fileno() for child in (self.simulation, self.recorder) if child]
        self.job = guardian_job(
            self.plan,
            sockets,
            self.memory,
            take_over=self.options.take_over,
            epoch_offset_ns=self.offset_ns,
        )
        Heartbeat(self.memory.heartbeat).set_steering(self.steering)
        show("guardian and loop")
        self.guardian = start_guardian(self.job, others)
        started = self.guardian.ready()
        if isinstance(started, Started):
            self.guardian_grants = started.grants
            if self.recorder:
                self.recorder.channel.send_message(LoopRuns(started.loop))
            # The guardian has already reaped the loop, and handles its end.
            with suppress(ProcessLookupError):
                self.loop = os.pidfd_open(started.loop)
                self.loop_signs = SignsOfLife(started.loop, _LOOK_NS, time.monotonic_ns())
        return self.guardian

    def post_pause(self) -> None:
        """Post a pause, with which a loop that waits for the gateway begins; the gateway ends it."""
        # Nothing else writes into the mailbox before the gateway.
        if self.held:
            MailboxWriter(self.memory.mailbox).post_command(CommandMessage(0, LOOP, "pause", b"", OWN_ORIGIN))

    def discard(self) -> None:
        """Remove the log of a run that sent nothing to the robot."""
        if self.log:
            discard_log(self.log)
            self.log = None

    def watch_guardian(self, guardian: Child[GuardianMessage], show: Callable[[Heartbeat], None]) -> None:
        """Wait for the guardian's last message; pass on stop requests by signals.

        Also returns when the guardian has exited, or was killed because it did not respond.
        """
        heartbeat = Heartbeat(self.memory.heartbeat)
        signs = SignsOfLife(guardian.process.pid, _LOOK_NS, time.monotonic_ns())
        asked, gone = 0, False
        while self.ended is None and not guardian.channel.closed:
            heartbeat.supervisor_look()
            if self.signals > asked:
                asked = self.signals
                guardian.channel.send_message(Stop() if asked == 1 else Cut())
            show(heartbeat)
            self._look_at_grants()
            self._look_after_gateway(heartbeat)
            heartbeat.set_steering(self.steering)
            self._look_after_simulation(guardian)
            for source in self.sources:
                source.supervise_process()
            loop = () if gone or self.loop is None else (self.loop,)
            message = guardian.poll_message(_GONE_POLL_S if gone else _POLL_S, *loop)
            gone = gone or bool(select.select(loop, [], [], 0)[0])
            signs.record_beat(heartbeat.looks, time.monotonic_ns())
            torque = heartbeat.phase not in (Phase.LOADING, Phase.DONE)
            urgent = torque and (gone or asked > 1)
            guardian_silent = signs.is_silent(URGENT_TIMEOUT_NS if urgent else GUARDIAN_TIMEOUT_NS)
            duty = self._duty(heartbeat, guardian_silent=guardian_silent, loop_gone=gone)
            if message:
                self._handle_message(message, guardian.channel.descriptors)
            elif duty is not Duty.NONE and not guardian.channel.closed:
                self.sentences.append("the guardian stopped watching the loop and was killed")
                guardian.kill()
                break

    def _duty(self, heartbeat: Heartbeat, *, guardian_silent: bool, loop_gone: bool = False) -> Duty:
        """Check the loop, and return this process' duty. A loop that is done does not count as silent."""
        silent = {WatchedProcess.GUARDIAN} if guardian_silent else set()
        phase, signs = heartbeat.phase, self.loop_signs
        if signs is not None and phase is not Phase.DONE:
            # Read before the heartbeat, as in the guardian.
            timeout_ns = loop_timeout_ns(heartbeat, self.plan.loop.period_ns)
            signs.record_beat((phase, heartbeat.beats), time.monotonic_ns())
            if loop_gone or signs.is_silent(timeout_ns):
                silent.add(WatchedProcess.LOOP)
        return duty_of(WatchedProcess.SUPERVISOR, silent)

    def _look_after_simulation(self, guardian: Child[GuardianMessage]) -> None:
        """Stop the run after the simulated servos have exited: unlike an adapter, they do not come back."""
        if self.simulation and self.simulation.process.poll() is not None:
            self.sentences.append("the simulated bus exited before the end of the run")
            self.simulation.end_process()
            self.simulation = None
            guardian.channel.send_message(Stop())

    def _handle_message(self, message: GuardianMessage, descriptors: list[int]) -> None:
        """Record the end of the loop; release a lost line, and hold a returned one."""
        match message:
            case Ended():
                self.ended = message
            case LineLost(bus):
                set_aside(descriptors[bus])
            case LineReturned(bus):
                put_in_place(descriptors.pop(len(self.plan.buses)), descriptors[bus])

    def _take_last_messages(self, guardian: Child[GuardianMessage]) -> None:
        """Process the last messages of an exited guardian. A guardian that was killed here leaves none."""
        while guardian.channel.fileno() >= 0 and (message := guardian.poll_message(0)):
            self._handle_message(message, guardian.channel.descriptors)

    def _look_at_grants(self) -> None:
        """Show and record the grants of the operating system, once the loop has reported them."""
        loop = () if self.grants else loop_grants(self.memory)
        if loop:
            self.grants = (*loop, *(replace(one, process="guardian") for one in self.guardian_grants))
            show_grants(self.grants, self.out, verbose=self.options.verbose)
            if self.recorder:
                self.recorder.channel.send_message(LateMetadata({"granted": granted_text(self.grants)}))

    def _look_after_gateway(self, heartbeat: Heartbeat) -> None:
        """Start the gateway when the loop runs, and process its messages."""
        if self.gateway is None:
            if self.steerable and heartbeat.phase is Phase.RUNNING:
                try:
                    self.gateway = start_gateway(self.log, self.memory, self.offset_ns, self.options.listen)
                except OSError as error:
                    self._without_gateway(f"did not start ({error.strerror or error})")
        elif message := self.gateway.poll_message(0):
            if isinstance(message, Listening):
                self.socket = Path(message.socket)
                self.held = False
            else:
                self._without_gateway(f"did not start ({message.sentence})")
        elif self.gateway.channel.closed:
            self._without_gateway("ended")

    def _without_gateway(self, what: str) -> None:
        """Report that the run can no longer be steered, and end a run that waits for the gateway."""
        self.steerable = False
        if self.held and self.guardian is not None:
            option = "omit --listen" if self.options.listen else "give --no-gateway"
            self.sentences.append(
                f"the gateway {what}, so the robot did not move; {option} to run without the gateway"
            )
            self.guardian.channel.send_message(Stop())
        else:
            self.remarks.append(f"the gateway {what}: the run continues, but cannot be steered")
        self._end_gateway()

    def _end_gateway(self) -> None:
        """Kill the gateway, which has no state to save, and remove its socket."""
        if self.gateway:
            message = self.gateway.poll_message(0)
            self.gateway.kill()
            self.gateway = None
            if isinstance(message, Listening):
                self.socket = Path(message.socket)
            if self.socket is not None:
                self.socket.unlink(missing_ok=True)

    def _without_guardian(self, loop: int, guardian: Child[GuardianMessage], job: GuardianJob) -> None:
        """Supervise the loop in place of an exited guardian.

        Linux has signalled the loop. Kill it if it does not stop, and switch torque off if it does not.
        """
        give_up = time.monotonic() + self.plan.exit_timeout_ns * 1e-9
        heartbeat = Heartbeat(self.memory.heartbeat)
        while not (gone := bool(select.select([loop], [], [], _GONE_POLL_S)[0])):
            silent = self._duty(heartbeat, guardian_silent=True) is Duty.KILL_BOTH
            # The second stop request may have gone to a guardian that no longer read it.
            if silent or time.monotonic() > give_up or self.signals > 1:
                signal.pidfd_send_signal(loop, signal.SIGKILL)
                select.select([loop], [], [])
                break
        phase = Heartbeat(self.memory.heartbeat).phase
        self.sentences.append("the guardian exited during the run")
        cut = self.signals > 1
        if phase is Phase.DONE and not cut:
            self.sentences.append("the loop ended normally by its policy")
        elif phase is not Phase.LOADING:
            called = Heartbeat(self.memory.heartbeat).activity
            where = f" in {called}" if called else ""
            how = f"the loop exited too{where}" if gone else f"the loop did not stop{where} and was killed"
            safe_stop = SafeStop(job)
            leave = safe_stop.limp if cut else safe_stop.apply_final_state
            self.sentences += leave(guardian.channel.descriptors, how, texts.loop_failed)

    def end_processes(self) -> None:
        """End the remaining processes in sequence: guardian, sources, recorder, simulated bus, gateway."""
        self._look_at_grants()
        if self.guardian:
            self._take_last_messages(self.guardian)
            self.guardian.end_process()
            if self.loop is not None and self.ended is None and self.job is not None:
                self._without_guardian(self.loop, self.guardian, self.job)
            self.loop = None
            let_go(self.guardian.channel.descriptors)
            self.guardian.channel.descriptors.clear()
        for source in self.sources:
            source.end_process()
        if self.recorder:
            self._end_recorder(self.recorder)
        if self.writer:
            self.remarks += self.writer.write_remaining()
        if self.simulation:
            self.simulation.end_process()
        # The gateway is the last: when its socket is gone, the log is closed.
        self._end_gateway()

    def _end_recorder(self, recorder: Child[RecorderMessage]) -> None:
        """Wait until the recorder has drained the rings and closed the log; report a failure."""
        # No ring has these sentences, and the verdict in the log must be that of the run.
        if self.sentences:
            failures = {str(number): sentence for number, sentence in enumerate(self.sentences)}
            recorder.channel.send_message(LateMetadata({FAILURES_NAME: failures}))
        recorder.channel.send_message(Finish())
        closed = False
        try:
            while (message := recorder.next_message(END_TIMEOUT_S)) is not None:
                if isinstance(message, Failed):
                    self.sentences.append(incomplete_log(message.sentence))
                elif isinstance(message, LogClosed):
                    closed = True
                    self.closed = message
                    self.messages = message.summary.messages
                    if gaps := message.summary.gaps:
                        self.sentences.append(
                            f"{counted(gaps, 'record is', 'records are')} missing in the log: "
                            "the recorder was too slow"
                        )
            recorder.end_process()
        except ProcessFault as fault:
            self.sentences.append(f"{fault} and was killed")
            recorder.kill()
        if not closed:
            last = CycleSpan.load(self.memory.span).last_cycle_text
            self.sentences.append(
                f"the recorder exited before the end of the run; {self.log} can be read: {last}"
            )


def run_robot(plan: Plan, options: RunOptions, out: Console) -> RunSummary:
    """Run a robot until its end, a signal, or a fault; all processes have exited on return.

    Raises PortError (a port is missing, busy, forbidden) and ProcessFault (a child did not start).
    """
    kept = read_states(plan, state_directory(plan))
    run = _Run(plan, options, create_memory(plan, kept), out, kept)
    if not out.is_terminal:
        show_parts(f"{plan.robot}: starting", console=out)
    with caught_signals(run.count_signal):
        try:
            with out.status(f"{plan.robot}: starting") as status:
                guardian = run.start_processes(lambda what: status.update(f"{plan.robot}: starting {what}"))
                run.watch_guardian(guardian, _watching(RunStatusLine(plan, status)))
        finally:
            run.end_processes()
            if run.guardian is None or Heartbeat(run.memory.heartbeat).phase is Phase.LOADING:
                run.discard()
            if options.debug:
                sys.stderr.write(child_processes.whole(run.memory.stderr).decode(errors="replace"))
    return _summary(run)


def _watching(progress: RunStatusLine) -> Callable[[Heartbeat], None]:
    """Return a function that updates the terminal's status line."""

    def show_phase(heartbeat: Heartbeat) -> None:
        if heartbeat.phase in (Phase.SETUP, Phase.ENGAGING):
            progress.setting_up()
        elif heartbeat.phase is Phase.RUNNING:
            progress.ran(heartbeat.cycles, heartbeat.skipped)

    return show_phase


def _summary(run: _Run) -> RunSummary:
    """Return the summary of a run, with exit code 0 good, 1 failed, 130 interrupted."""
    outcome = loop_outcome(run.memory)
    heartbeat = Heartbeat(run.memory.heartbeat)
    sentences: list[str] = []
    if outcome is None and run.ended is not None and run.ended.ending == "done":
        # The loop was still loading: no byte had been sent.
        outcome = LoopOutcome("stopped")
    elif outcome is None:
        outcome = LoopOutcome("fault", heartbeat.cycles, heartbeat.skipped, _last_words(run.memory))
    sentences += outcome.sentences
    if run.ended is not None:
        sentences += run.ended.outcome
    sentences += run.sentences
    interrupted = run.signals > 0
    in_order = interrupted and (run.ended is None or run.ended.ending in ("done", "unused", "cut"))
    bad: Literal[0, 1] = 1 if outcome.reason not in ("ended", "stopped") or sentences else 0
    return RunSummary(
        exit_code=130 if in_order and not outcome.sentences and not run.sentences else bad,
        reason="interrupted" if interrupted else outcome.reason,
        cycles=outcome.cycles,
        skipped=outcome.skipped,
        sentences=tuple(sentences),
        remarks=(*refusals(run.grants, run.out), *outcome.remarks, *run.remarks),
        log=str(run.log) if run.log and run.log.exists() else None,
        messages=run.messages,
        invalid=outcome.invalid,
        paused=outcome.paused,
        outside=outcome.outside,
        events=outcome.events,
        refused_for_replies=outcome.refused_for_replies,
        start_up_load=run.closed.start_up_load if run.closed else MachineLoad(),
        run_load=run.closed.run_load if run.closed else MachineLoad(),
        simulation_wait=outcome.simulation_wait,
    )


def _last_words(memory: RunMemory) -> tuple[str, ...]:
    """Return the last output of the run's processes, the probable reason of an early end."""
    lines = child_processes.whole(memory.stderr).decode(errors="replace").strip().splitlines()
    return (f"the run's processes printed last: {lines[-1]} (--debug shows all)",) if lines else ()
