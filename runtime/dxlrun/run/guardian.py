"""Guardian: the process that holds the ports, and makes the robot safe when its loop has exited.

A small process with a priority one above the loop. It opens and locks the ports, executes the loop's process
as its child, which inherits the ports' descriptors, and watches that child. The pidfd shows at once that the
loop has exited; the heartbeat shows that it hangs. A loop that exits before it has reported DONE, or that
hangs, is killed and reaped. Then the guardian switches the torque of every servo off with the packets that
the plan prepared. When the supervisor is dead or stopped, the guardian asks the loop to stop (`watch.py`). It
also opens lines again that the loop has lost, and passes them on.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import msgspec
from msgspec.json import Decoder

from dxlrun.channels import child_processes
from dxlrun.channels.child_processes import (
    Cut,
    Failed,
    LineLost,
    LineReturned,
    MessageChannel,
    RunMemory,
    Stop,
)
from dxlrun.channels.event_records import CommandOutside, EventBody, EventRing, EventText, EventTotals
from dxlrun.channels.heartbeat import Heartbeat, Phase, ProcessorTime, SimulationProgress
from dxlrun.channels.logged_packets import PacketBatch, salvage
from dxlrun.channels.ring import RingReader, RingWriter
from dxlrun.channels.shared_memory import mapped
from dxlrun.control import realtime_grants
from dxlrun.dynamixel.bus_part import SafeEnd
from dxlrun.dynamixel.servo.torque_off import limp, stand
from dxlrun.errors import PortError
from dxlrun.features.feature import Feature
from dxlrun.plan.machine_load import SimulationWait
from dxlrun.plan.policy_plan import TORQUE_STAYS, Last
from dxlrun.process_table import describe_run
from dxlrun.run import texts
from dxlrun.run.process_watch import Duty, SignsOfLife, WatchedProcess, duty_of, loop_timeout_ns
from dxlwire.bus_plan import SIMULATED, BusPlan
from dxlwire.clock import MonotonicClock
from dxlwire.exchange.bus_engine import Lines
from dxlwire.port.ports import SerialPort, SerialPorts, SimulatedPort, StallCounter
from dxlwire.port.reopening import KeptLines, LineSettings

_NEVER = 1 << 62

LEAST_NAP_NS, LONGEST_NAP_NS = 5_000_000, 10_000_000
"""Shortest and longest interval at which the guardian checks the loop; the loop's period if in between. A
check takes about 60 us from a loop on the same core."""
LONGEST_LOOK_NS = 20_000_000
"""Upper limit of the time, ns, that one check adds to a standstill of the loop: while the guardian was not
running, the loop may not have run either.
"""

Ending = Literal["done", "unused", "died", "hung", "late", "cut"]
"""Kind of a loop's end. done: it ended normally; unused: before a byte was sent; after all others, the
guardian makes the robot safe.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardianPlan:
    """The part of the robot's plan that the guardian needs to watch a loop and to make the robot safe."""

    buses: tuple[BusPlan, ...]
    features: tuple[Feature, ...]
    feature_plans: Mapping[str, bytes]
    """Encoded plan (`Contribution.plan`) of each feature, by name of the feature."""
    period_ns: int
    exit_timeout_ns: int
    """Time after a stop request after which a loop that still runs is killed."""
    priority: int
    """Real-time priority of the guardian; 0: none."""
    lock_memory: bool
    last: Last
    """State, limp or hold, in which the robot is left if the loop dies in the middle of a run."""


@dataclass(frozen=True, slots=True)
class GuardianJob:
    """Arguments of the guardian's process: its plan, and memory for guardian and loop."""

    plan: GuardianPlan
    memory: RunMemory
    sockets: Mapping[str, int]
    """Descriptor of the socket to each simulated bus, by name of the bus."""
    supervisor: int
    """Process ID of the supervisor."""
    take_over: bool = False
    """True if the loop accepts servos that already have torque."""
    epoch_offset_ns: int = 0
    """Wall time minus the run's clock, ns."""


@dataclass(frozen=True, slots=True)
class LoopJob:
    """Arguments of the loop's process, from the guardian."""

    memory: RunMemory
    take_over: bool
    ports: tuple[int, ...]
    """File descriptors of the open ports, in the order of the plan's buses."""
    channel: int
    """File descriptor of the channel to the guardian, which reopens lost lines."""
    supervisor: int
    """Process ID of the supervisor."""
    guardian: int
    """Process ID of the guardian."""
    epoch_offset_ns: int = 0


class LoopOutcome(msgspec.Struct, frozen=True):
    """Result that the loop's process leaves in shared memory for the supervisor."""

    reason: str
    """Reason why the loop ended: ended, stopped, fault, or start-up (it could not start)."""
    cycles: int = 0
    skipped: int = 0
    sentences: tuple[str, ...] = ()
    """Errors for the user, one sentence each."""
    remarks: tuple[str, ...] = ()
    """Remarks for the user, one sentence each."""
    traceback: str = ""
    invalid: tuple[int, ...] = ()
    """Number of cycles with an invalid servo state, a value for each joint."""
    paused: int = 0
    outside: tuple[CommandOutside, ...] = ()
    events: EventTotals = EventTotals()
    refused_for_replies: bool = False
    """True when the start was refused because of late or missing replies."""
    simulation_wait: SimulationWait = SimulationWait()


class Started(msgspec.Struct, frozen=True, tag=True):
    """Message from guardian to supervisor: the loop's process runs. The open ports are attached."""

    loop: int
    """Process ID of the loop."""
    grants: tuple[realtime_grants.Grant, ...]
    """Results of the guardian's real-time requests."""


class Ended(msgspec.Struct, frozen=True, tag=True):
    """Message from guardian to supervisor: the loop has exited, and the robot is in its final state."""

    ending: Ending
    outcome: tuple[str, ...] = ()
    """Sentences about what the guardian did in place of supervisor or loop."""


GuardianMessage = Started | LineLost | LineReturned | Ended | Failed
_REQUESTS: Decoder[Stop | Cut] = Decoder(Stop | Cut)
_LINES_LOST = Decoder(LineLost)
EndText: TypeAlias = EventText[[Sequence[str]]]
"""Template of the event about the end of a loop: `texts.loop_failed` or `texts.run_cut`."""


def make_ports(
    buses: Sequence[BusPlan],
    descriptors: Sequence[int],
    memory: RunMemory,
    stalls: StallCounter,
) -> list[SerialPort]:
    """Return the serial ports of all buses.

    Those of simulated servos wait while the simulation has no core.

    Args:
        buses: The plan's buses.
        descriptors: File descriptors of the ports.
        memory: Memory of the run, with the progress of the simulation.
        stalls: Counter of these waits.
    """
    ports: list[SerialPort] = []
    simulated = 0
    for bus, descriptor in zip(buses, descriptors, strict=True):
        if bus.port == SIMULATED:
            line = SimulationProgress(memory.simulation).line(simulated)
            ports.append(SimulatedPort(descriptor, bus.port, line, stalls))
            simulated += 1
        else:
            ports.append(SerialPort(descriptor, bus.port))
    return ports


class SafeStop:
    """Makes the robot safe after the loop has exited, and reports the result to log and terminal."""

    def __init__(self, job: GuardianJob) -> None:
        self._job = job
        self._clock = MonotonicClock()
        self._heartbeat = Heartbeat(job.memory.heartbeat)
        self._ring = RingWriter(job.memory.guardian)
        self._events = EventRing(self._ring, self._clock)
        self._safe_end = SafeEnd.import_stages(job.plan.features, job.plan.feature_plans)

    def apply_final_state(self, descriptors: Sequence[int], how: str, text: EndText) -> list[str]:
        """Leave the robot limp or holding, as the fault policy's final state says; return sentences about it.

        The steps of the policy are skipped. The robot holds only when the loop was running: during set-up,
        only some servos have torque.
        """
        if self._job.plan.last == "limp" or self._heartbeat.phase is not Phase.RUNNING:
            return self.limp(descriptors, how, text)
        sentences = [how, TORQUE_STAYS, *self.stand(descriptors)]
        self.report(text(sentences))
        return sentences

    def stand(self, descriptors: Sequence[int]) -> tuple[str, ...]:
        """Stop joints that would continue to move with torque on; return a sentence for each failure."""
        lines, packets = self._take_over(descriptors)
        sentences = (*stand(lines), *self._safe_end.make_safe(lines))
        packets.commit_packets()
        return sentences

    def limp(self, descriptors: Sequence[int], how: str, text: EndText) -> list[str]:
        """Send torque off to every servo; return `how` (the cause) and the result as sentences."""
        lines, packets = self._take_over(descriptors)
        outcome, unsafe = limp(lines), self._safe_end.make_safe(lines)
        packets.commit_packets()
        silent = [str(one) for one in outcome if not one.confirmed]
        servos = "the servo" if len(outcome) == 1 else f"all {len(outcome)} servos"
        result = (
            f"torque off was confirmed by {servos}"
            if not silent
            else f"torque off was sent, but not confirmed by {', '.join(silent)}"
        )
        sentences = [how, result, *unsafe]
        self.report((texts.loop_failed if silent else text)(sentences))
        return sentences

    def _take_over(self, descriptors: Sequence[int]) -> tuple[Lines, PacketBatch]:
        """Log the loop's unfinished packets; return the robot's lines and a batch for further packets."""
        job, memory = self._job, self._job.memory
        cycle = salvage(mapped(memory.desk), RingReader(memory.packets).head, self._ring)
        ports = SerialPorts(make_ports(job.plan.buses, descriptors, memory, StallCounter()))
        packets = PacketBatch(self._ring, cycle=cycle)
        return Lines(
            job.plan.buses, ports, self._clock, packets, self._heartbeat.mark_guardian_alive
        ), packets

    def report_grants(self, grants: Sequence[realtime_grants.Grant]) -> None:
        """Log the results of the guardian's real-time requests."""
        realtime_grants.log_grants(grants, "guardian", self._events)

    def report(self, event: EventBody) -> None:
        """Log an event with the guardian as its source."""
        self._events.emit_event("guardian", event)


class Guardian:
    """Starts one loop process, watches it to its end, and makes the robot safe if it fails."""

    def __init__(self, job: GuardianJob, control: MessageChannel[Stop | Cut]) -> None:
        self._job = job
        self._control = control
        self._clock = MonotonicClock()
        self._heartbeat = Heartbeat(job.memory.heartbeat)
        self._safe_stop = SafeStop(job)
        self._loop_signs = SignsOfLife(os.getpid(), LONGEST_LOOK_NS, self._clock.now_ns())
        self._supervisor_signs = SignsOfLife(job.supervisor, LONGEST_LOOK_NS, self._clock.now_ns())
        self._stop_by_ns = _NEVER
        self._unsupervised = ""
        """Sentence: why the guardian asked the loop to stop without a request; empty: it did not."""
        self._killed: Literal["hung", "late", "cut"] | None = None
        """Reason why the guardian killed the loop; None: it did not."""
        self._starved_ns: int | None = None
        """Processor time of a loop that stood still although it was ready to run, ns; None: not known."""
        self._halted = False
        """True when the loop was killed because a signal had stopped it."""

    def guard_loop(self) -> None:
        """Open the ports, execute and watch the loop, and make the robot safe after the loop has exited."""
        lines = KeptLines(
            [
                LineSettings(
                    bus.port,
                    bus.baud_rate,
                    bus.latency_ns,
                    bus.rs485,
                    bus.boot_ns,
                    self._job.sockets.get(bus.name, -1),
                )
                for bus in self._job.plan.buses
            ],
            describe_holder=describe_run,
        )
        # The grants apply to this process only: the loop is executed later and inherits none of them.
        grants = realtime_grants.apply_to_guardian(self._job.plan.priority, self._job.plan.lock_memory)
        self._safe_stop.report_grants(grants)
        for sentence in lines.done:
            self._safe_stop.report(texts.line_adjusted(sentence))
        for sentence in lines.remarks:
            self._safe_stop.report(texts.line_remark(sentence))
        loop_channel, theirs = child_processes.message_channel(_LINES_LOST)
        loop = self._start_loop(lines.descriptors, theirs.fileno())
        theirs.close()
        # The supervisor receives the ports too. They stay open and locked if the guardian dies.
        self._control.send_message(Started(loop.pid, grants), lines.descriptors)
        ending = self._watch(loop, lines, loop_channel)
        outcome = [self._unsupervised] if self._unsupervised else []
        how = self._how(ending, loop)
        if ending == "unused":
            outcome.append(f"{how}; nothing had been sent to the robot")
            self._safe_stop.report(texts.loop_failed(outcome[-1:]))
        elif ending != "done":
            # Add a line that returned just now, so that its servos receive torque off as well.
            lines.returned()
            if ending == "cut":
                outcome += self._safe_stop.limp(lines.descriptors, how, texts.run_cut)
            else:
                outcome += self._safe_stop.apply_final_state(lines.descriptors, how, texts.loop_failed)
        lines.close()
        self._control.send_message(Ended(ending, tuple(outcome)))

    def _start_loop(self, descriptors: list[int], channel: int) -> subprocess.Popen[bytes]:
        given = self._job
        job = LoopJob(
            given.memory,
            given.take_over,
            tuple(descriptors),
            channel,
            given.supervisor,
            os.getpid(),
            given.epoch_offset_ns,
        )
        return child_processes.start_module(
            "dxlrun.run.loop_process",
            ["--job", msgspec.json.encode(job).decode()],
            [*job.memory.of_loop, *descriptors, channel],
            job.memory.stderr,
        )

    def _watch(
        self, loop: subprocess.Popen[bytes], lines: KeptLines, channel: MessageChannel[LineLost]
    ) -> Ending:
        """Watch the loop and kill it if it hangs, until it has exited; reap it and return the kind of end."""
        watched = os.pidfd_open(loop.pid)
        processor = ProcessorTime(Path(f"/proc/{loop.pid}"))
        self._loop_signs = SignsOfLife(loop.pid, LONGEST_LOOK_NS, self._clock.now_ns())
        nap = min(max(self._job.plan.period_ns, LEAST_NAP_NS), LONGEST_NAP_NS) * 1e-9
        while True:
            # A closed channel is always readable and would cause a busy wait.
            channels = [one for one in (self._control, channel) if not one.closed]
            ready, _, _ = select.select([watched, lines, *channels], [], [], nap)
            self._heartbeat.mark_guardian_alive()
            if watched in ready:
                return self._ending(loop.wait())
            if channel in ready:
                self._lose(lines, channel)
            if lines in ready:
                self._pass_on_lines(lines, channel)
            request = self._request() if self._control in ready else None
            duty = duty_of(WatchedProcess.GUARDIAN, self._silent())
            processor.note_standstill(self._loop_signs.still_ns)
            if duty is Duty.STOP_LOOP and not self._unsupervised:
                self._report_unsupervised()
            if request == "stop" or (duty is Duty.STOP_LOOP and self._stop_by_ns == _NEVER):
                self._stop_by_ns = min(
                    self._stop_by_ns, self._clock.now_ns() + self._job.plan.exit_timeout_ns
                )
                loop.send_signal(signal.SIGTERM)
            reason = "cut" if request == "cut" else self._reason_to_kill(duty)
            if reason and not self._killed:
                self._note_standstill(reason, processor)
                self._killed = reason
                loop.kill()

    def _ending(self, code: int) -> Ending:
        """Return the kind of end of a loop that has exited or was killed."""
        phase, killed = self._heartbeat.phase, self._killed
        if phase is Phase.DONE and (code in (0, 1) or killed == "hung"):
            return "done"
        if phase is Phase.LOADING and killed in ("hung", "late"):
            return "unused"
        if killed:
            return killed
        if phase is Phase.LOADING:
            return "done" if code == -signal.SIGTERM and self._stop_by_ns < _NEVER else "unused"
        return "died"

    def _lose(self, lines: KeptLines, channel: MessageChannel[LineLost]) -> None:
        """Start to reopen the lines that the loop has reported as lost, and inform the supervisor."""
        for message in channel.receive_messages():
            self._control.send_message(message)
            if not lines.lost(message.bus):
                self._safe_stop.report(texts.line_gone())

    def _pass_on_lines(self, lines: KeptLines, channel: MessageChannel[LineLost]) -> None:
        """Pass the ports of lines that are open again to the loop and to the supervisor."""
        for opened in lines.returned():
            if opened.done:
                self._safe_stop.report(texts.line_adjusted(opened.done))
            if opened.remark:
                self._safe_stop.report(texts.line_remark(opened.remark))
            if opened.wrong:
                self._safe_stop.report(texts.line_problem(opened.wrong))
            for each in (channel, self._control):
                each.send_message(LineReturned(opened.index), [lines.descriptors[opened.index]])

    def _silent(self) -> frozenset[WatchedProcess]:
        """Check the heartbeats of loop and supervisor; return which of them do not respond.

        A dead supervisor has closed its channel.
        """
        now_ns, phase = self._clock.now_ns(), self._heartbeat.phase
        # Read before the heartbeat: the loop beats first, and shortens its timeout afterwards.
        timeout_ns = self._timeout_ns()
        self._loop_signs.record_beat((phase, self._heartbeat.beats), now_ns)
        self._supervisor_signs.record_beat(self._heartbeat.supervisor_looks, now_ns)
        silent = {
            WatchedProcess.LOOP: self._loop_signs.is_silent(timeout_ns),
            WatchedProcess.SUPERVISOR: self._control.closed or self._supervisor_signs.is_halted(),
        }
        return frozenset(which for which, is_silent in silent.items() if is_silent)

    def _reason_to_kill(self, duty: Duty) -> Literal["hung", "late"] | None:
        """Return why the loop must be killed now: hung, or late after a stop request; None: it must not."""
        if duty is Duty.KILL_LOOP:
            return "hung"
        return "late" if self._clock.now_ns() > self._stop_by_ns else None

    def _timeout_ns(self) -> float:
        return loop_timeout_ns(self._heartbeat, self._job.plan.period_ns)

    def _note_standstill(self, reason: str, processor: ProcessorTime) -> None:
        """Store why the loop stood still (signal, no processor) before it is killed for that."""
        if reason == "hung":
            self._halted = self._loop_signs.still_ns <= self._timeout_ns()
            self._starved_ns = processor.starved_ns(self._loop_signs.still_ns)

    def _report_unsupervised(self) -> None:
        """Log that the supervisor is dead or stopped, so that nobody else can end the run."""
        what = "has exited" if self._control.closed else "was suspended (such as by Ctrl-Z)"
        self._unsupervised = (
            f"the supervisor (process {self._job.supervisor}) {what}; the loop was asked to stop"
        )
        self._safe_stop.report(texts.supervisor_gone(self._unsupervised))

    def _request(self) -> Literal["stop", "cut"] | None:
        """Read the supervisor's messages; return the strongest request in them, or None without a message.

        `cut`: kill the loop and cut the servos' torque at once. `stop`: end the run by its exit policy.
        """
        messages = self._control.receive_messages()
        if any(isinstance(message, Cut) for message in messages):
            return "cut"
        return "stop" if messages else None

    def _how(self, ending: Ending, loop: subprocess.Popen[bytes]) -> str:
        """Return a sentence on how the loop ended, with the controller whose code was running."""
        if ending == "cut":
            return "torque was cut on request"
        called = self._heartbeat.activity
        where = f" in {called}" if called else ""
        if self._killed == "hung":
            if self._halted:
                return f"the loop was suspended by a signal{where} and was killed"
            still = _duration(self._timeout_ns())
            return f"the loop did not respond for more than {still}{where} and was killed{self._starved()}"
        if self._killed == "late":
            limit = _duration(self._job.plan.exit_timeout_ns)
            return f"the loop did not stop within {limit}{where} and was killed"
        return f"the loop's process exited unexpectedly ({_manner(loop.returncode)}){where}"

    def _starved(self) -> str:
        """Return a clause about a loop that was ready to run but got no processor; empty when not known."""
        if self._starved_ns is None:
            return ""
        got = f"; it was ready to run but received only {self._starved_ns / 1e6:.1f} ms of processor time"
        fix = "; write loop.scheduler.policy: round_robin to run it before other programs"
        return got if self._job.plan.priority else got + fix


def _duration(time_ns: float) -> str:
    """Format a time in s or ms."""
    return f"{time_ns / 1e9:g} s" if time_ns >= 1e9 else f"{time_ns / 1e6:.0f} ms"


def _manner(code: int | None) -> str:
    """Return the signal that ended a process, or its exit code, as text."""
    if code is not None and code < 0:
        return f"signal {signal.Signals(-code).name}"
    return f"exit code {code}"


def main() -> None:
    """Run the guardian's process: `--job-fd N --control-fd M`."""
    job, control = child_processes.begun(GuardianJob, _REQUESTS)
    try:
        Guardian(job, control).guard_loop()
    except PortError as error:
        control.send_message(Failed(str(error)))
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
