"""Guardian: the process that keeps the ports, and leaves the robot safe when its loop is gone.

A small process, one priority above the loop. It opens, locks and keeps the ports' descriptors, executes the
loop's process on them as its child, and watches that child: by its pidfd, which shows at once that it ended,
and by its heartbeat, which shows that it hangs. A loop that is gone before it reported DONE, or that stands
still, is killed and reaped, and then every servo is made limp with the packets that the plan prepared. When
the supervisor is dead or stopped, the loop is asked to stop (`watch.py`). A line that the loop has lost is
opened again and handed over.
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
from typing import Literal

import msgspec
from msgspec.json import Decoder

from dxlrun.channels import process
from dxlrun.channels.events import EventCode, EventRing, Severity
from dxlrun.channels.heartbeat import Heartbeat, Phase, ProcessorTime, SimulationProgress
from dxlrun.channels.packets import PacketBatch, salvage
from dxlrun.channels.process import Cut, Failed, LineLost, LineReturned, MessageChannel, RunMemory, Stop
from dxlrun.channels.ring import RingReader, RingWriter
from dxlrun.channels.shared_memory import mapped
from dxlrun.control import realtime
from dxlrun.description.bus import SIMULATED
from dxlrun.dynamixel.bus_part import SafeEnd
from dxlrun.dynamixel.servo.torque_off import limp, stand
from dxlrun.errors import PortError
from dxlrun.features.feature import Feature
from dxlrun.plan.policy_plan import TORQUE_STAYS, Last
from dxlrun.process_table import describe_run
from dxlrun.run.watch import Duty, SignsOfLife, Watched, duty_of, loop_timeout_ns
from dxlwire.bus_plan import BusPlan
from dxlwire.clock import MonotonicClock
from dxlwire.exchange.bus import Lines
from dxlwire.port.ports import SerialPort, SerialPorts, SimulatedPort, StallCounter
from dxlwire.port.reopening import KeptLines, Wanted

_NEVER = 1 << 62

LEAST_NAP_NS, LONGEST_NAP_NS = 5_000_000, 10_000_000
"""It looks at the loop once a period within these bounds: a look takes some 60 us from a loop on its core."""
LONGEST_LOOK_NS = 20_000_000
"""One look of the guardian counts for at most this: when it was not running, the loop may not have been."""

Ending = Literal["done", "unused", "died", "hung", "late", "cut"]
"""done: by itself, torque off; unused: before a byte was sent; the others leave torque off to us."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardianPlan:
    """The guardian's share of the robot's plan: enough to watch a loop, and to leave the robot safe."""

    buses: tuple[BusPlan, ...]
    features: tuple[Feature, ...]
    feature_plans: Mapping[str, bytes]
    """`Contribution.plan` by feature."""
    period_ns: int
    exit_timeout_ns: int
    """How long the loop may take to stop when it is asked to."""
    priority: int
    """Real-time priority of the guardian; 0: none."""
    lock_memory: bool
    last: Last
    """How the robot is left when the loop is gone in the middle of a run."""


@dataclass(frozen=True, slots=True)
class GuardianJob:
    """What the guardian works on: the plan, and the ports and descriptors that it and the loop inherit."""

    plan: GuardianPlan
    ports: tuple[str, ...]
    """Device paths, in the order of `plan.buses`; a simulated bus has its pseudo-terminal here."""
    memory: RunMemory
    supervisor: int
    """Process ID."""
    take_over: bool = False
    """The loop accepts servos that are already torqued."""
    epoch_offset_ns: int = 0
    """Wall time = time of the run's clock + this."""


@dataclass(frozen=True, slots=True)
class LoopJob:
    """What the loop's process works on."""

    memory: RunMemory
    take_over: bool
    ports: tuple[int, ...]
    """Descriptors, in the order of the plan's buses."""
    channel: int
    """To the guardian, which opens lines that are gone again."""
    supervisor: int
    """Process ID."""
    guardian: int
    """Process ID."""
    epoch_offset_ns: int = 0


class Started(msgspec.Struct, frozen=True, tag=True):
    """Guardian to terminal: the loop is executed; the ports come along."""

    loop: int
    """Process ID."""
    grants: tuple[realtime.Grant, ...]
    """What the operating system granted to the guardian."""


class Ended(msgspec.Struct, frozen=True, tag=True):
    """Guardian to terminal: the loop is gone, and the robot is left as by its policy."""

    ending: Ending
    outcome: tuple[str, ...] = ()
    """What the guardian did in place of supervisor or loop, one sentence each."""


GuardianMessage = Started | LineLost | LineReturned | Ended | Failed
_REQUESTS: Decoder[Stop | Cut] = Decoder(Stop | Cut)
_LINES_LOST = Decoder(LineLost)


def make_ports(
    buses: Sequence[BusPlan],
    names: Sequence[str],
    descriptors: Sequence[int],
    memory: RunMemory,
    stalls: StallCounter,
) -> list[SerialPort]:
    """Return the ports of all buses; those of simulated servos wait for a process that has no core.

    Args:
        buses: The plan's buses.
        names: Names of their ports, for messages.
        descriptors: Descriptors of their ports.
        memory: Memory of the run, which has the progress of the simulation.
        stalls: Counts these waits.
    """
    ports: list[SerialPort] = []
    simulated = 0
    for bus, name, descriptor in zip(buses, names, descriptors, strict=True):
        if bus.port == SIMULATED:
            line = SimulationProgress(memory.simulation).line(simulated)
            ports.append(SimulatedPort(descriptor, name, line, stalls))
            simulated += 1
        else:
            ports.append(SerialPort(descriptor, name))
    return ports


class SafeStop:
    """Switches torque off instead of a loop that is gone, and reports the result to log and terminal."""

    def __init__(self, job: GuardianJob) -> None:
        self._job = job
        self._clock = MonotonicClock()
        self._heartbeat = Heartbeat(job.memory.heartbeat)
        self._ring = RingWriter(job.memory.guardian)
        self._events = EventRing(self._ring, self._clock)
        self._safe_end = SafeEnd.of(job.plan.features, job.plan.feature_plans)

    def end(self, descriptors: Sequence[int], how: str, severity: Severity) -> list[str]:
        """Leave the robot as the policy for a fault does, without its steps; return that as sentences.

        A robot holds only when it ran: in a set-up some servos have torque and others have not.
        """
        if self._job.plan.last == "limp" or self._heartbeat.phase is not Phase.RUNNING:
            return self.limp(descriptors, how, severity)
        standing = self.stand(descriptors)
        self.report("; ".join([how, TORQUE_STAYS, *standing]), severity)
        return [how, TORQUE_STAYS, *standing]

    def stand(self, descriptors: Sequence[int]) -> tuple[str, ...]:
        """Stop the joints that would go on moving with their torque on; return a sentence for each."""
        lines, packets = self._take_over(descriptors)
        sentences = (*stand(lines), *self._safe_end.make_safe(lines))
        packets.commit()
        return sentences

    def limp(self, descriptors: Sequence[int], how: str, severity: Severity) -> list[str]:
        """Send torque off to every servo; return `how` it came to that, and the result, as sentences."""
        lines, packets = self._take_over(descriptors)
        outcome, unsafe = limp(lines), self._safe_end.make_safe(lines)
        packets.commit()
        silent = [str(one) for one in outcome if not one.confirmed]
        servos = "the servo" if len(outcome) == 1 else f"all {len(outcome)} servos"
        result = (
            f"torque off was confirmed by {servos}"
            if not silent
            else f"torque off was sent, but not confirmed by {', '.join(silent)}"
        )
        self.report("; ".join([how, result, *unsafe]), Severity.ERROR if silent else severity)
        return [how, result, *unsafe]

    def _take_over(self, descriptors: Sequence[int]) -> tuple[Lines, PacketBatch]:
        """Bring what the loop had on its desk into the log; return its lines, and where packets go now."""
        job, memory = self._job, self._job.memory
        cycle = salvage(mapped(memory.desk), RingReader(memory.packets).head, self._ring)
        ports = SerialPorts(make_ports(job.plan.buses, job.ports, descriptors, memory, StallCounter()))
        packets = PacketBatch(self._ring, cycle=cycle)
        return Lines(job.plan.buses, ports, self._clock, packets, self._heartbeat.look), packets

    def report_grants(self, grants: Sequence[realtime.Grant]) -> None:
        """Put into the log what the operating system granted to this process."""
        realtime.log_grants(grants, "guardian", self._events)

    def report(self, text: str, severity: Severity) -> None:
        """Put a sentence into the log."""
        self._events.emit(EventCode.GUARDIAN, severity, "guardian", text)


class Guardian:
    """Watches one loop process from its start to its end."""

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
        """Why the loop was asked to stop although nobody requested that."""
        self._killed: Literal["hung", "late", "cut"] | None = None
        """Why the loop was killed."""
        self._starved_ns: int | None = None
        """The processor time that it got while it stood still, where it wanted more."""
        self._halted = False
        """The loop was killed because a signal had stopped it."""

    def run(self) -> None:
        """Open the ports, execute the loop, watch it, and see that the robot is limp when it is gone."""
        lines = KeptLines(
            [
                Wanted(path, bus.baud_rate, bus.latency_ns, bus.rs485, bus.boot_ns)
                for path, bus in zip(self._job.ports, self._job.plan.buses, strict=True)
            ],
            describe_holder=describe_run,
        )
        # before the loop is executed, which inherits none of it
        grants = realtime.apply_to_guardian(self._job.plan.priority, self._job.plan.lock_memory)
        self._safe_stop.report_grants(grants)
        for sentence in lines.done:
            self._safe_stop.report(sentence, Severity.INFO)
        for sentence in lines.remarks:
            self._safe_stop.report(sentence, Severity.WARNING)
        loop_channel, theirs = process.message_channel(_LINES_LOST)
        loop = self._execute(lines.descriptors, theirs.fileno())
        theirs.close()
        # the terminal gets the ports too: should this process die, they are still held, and still open
        self._control.send(Started(loop.pid, grants), lines.descriptors)
        ending = self._watch(loop, lines, loop_channel)
        outcome = [self._unsupervised] if self._unsupervised else []
        how = self._how(ending, loop)
        if ending == "unused":
            outcome.append(f"{how}; nothing had been sent to the robot")
            self._safe_stop.report(outcome[-1], Severity.ERROR)
        elif ending != "done":
            lines.returned()  # one that came back in this moment is to hear it, too
            if ending == "cut":
                outcome += self._safe_stop.limp(lines.descriptors, how, Severity.WARNING)
            else:
                outcome += self._safe_stop.end(lines.descriptors, how, Severity.ERROR)
        lines.close()
        self._control.send(Ended(ending, tuple(outcome)))

    def _execute(self, descriptors: list[int], channel: int) -> subprocess.Popen[bytes]:
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
        return process.start_module(
            "dxlrun.run.loop_process",
            ["--job", msgspec.json.encode(job).decode()],
            [*job.memory.of_loop, *descriptors, channel],
            job.memory.stderr,
        )

    def _watch(
        self, loop: subprocess.Popen[bytes], lines: KeptLines, channel: MessageChannel[LineLost]
    ) -> Ending:
        """Return how the loop ended; it is dead and reaped then."""
        watched = os.pidfd_open(loop.pid)
        processor = ProcessorTime(Path(f"/proc/{loop.pid}"))
        self._loop_signs = SignsOfLife(loop.pid, LONGEST_LOOK_NS, self._clock.now_ns())
        nap = min(max(self._job.plan.period_ns, LEAST_NAP_NS), LONGEST_NAP_NS) * 1e-9
        while True:
            # a terminal that is gone would wake it for ever, a loop that is gone asks for nothing
            channels = [one for one in (self._control, channel) if not one.closed]
            ready, _, _ = select.select([watched, lines, *channels], [], [], nap)
            self._heartbeat.look()
            if watched in ready:
                return self._ending(loop.wait())
            if channel in ready:
                self._lose(lines, channel)
            if lines in ready:
                self._hand_over(lines, channel)
            request = self._request() if self._control in ready else None
            duty = duty_of(Watched.GUARDIAN, self._silent())
            processor.look(self._loop_signs.still_ns)
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
        """Return how a loop ended that was killed for a reason, or ended by itself."""
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
        """Open the lines again that the loop has lost."""
        for message in channel.receive():
            self._control.send(message)
            if not lines.lost(message.bus):
                self._safe_stop.report("a line is gone and is not opened again", Severity.ERROR)

    def _hand_over(self, lines: KeptLines, channel: MessageChannel[LineLost]) -> None:
        """Hand lines that are back to the loop and to the terminal."""
        for opened in lines.returned():
            if opened.done:
                self._safe_stop.report(opened.done, Severity.INFO)
            if opened.remark:
                self._safe_stop.report(opened.remark, Severity.WARNING)
            if opened.wrong:
                self._safe_stop.report(opened.wrong, Severity.ERROR)
            for each in (channel, self._control):
                each.send(LineReturned(opened.index), [lines.descriptors[opened.index]])

    def _silent(self) -> frozenset[Watched]:
        """Return which of the others do not respond; a supervisor that has ended closed its channel."""
        now_ns, phase = self._clock.now_ns(), self._heartbeat.phase
        timeout_ns = self._timeout_ns()  # first: the loop beats before it asks for less of it
        self._loop_signs.look((phase, self._heartbeat.beats), now_ns)
        self._supervisor_signs.look(self._heartbeat.supervisor_looks, now_ns)
        silent = {
            Watched.LOOP: self._loop_signs.is_silent(timeout_ns),
            Watched.SUPERVISOR: self._control.closed or self._supervisor_signs.is_halted(),
        }
        return frozenset(which for which, is_silent in silent.items() if is_silent)

    def _reason_to_kill(self, duty: Duty) -> Literal["hung", "late"] | None:
        """Return why the loop is not waited for any longer, if it is not."""
        if duty is Duty.KILL_LOOP:
            return "hung"
        return "late" if self._clock.now_ns() > self._stop_by_ns else None

    def _timeout_ns(self) -> float:
        return loop_timeout_ns(self._heartbeat, self._job.plan.period_ns)

    def _note_standstill(self, reason: str, processor: ProcessorTime) -> None:
        """Note why a loop stands still, before it is killed for that."""
        if reason == "hung":
            self._halted = self._loop_signs.still_ns <= self._timeout_ns()
            self._starved_ns = processor.starved_ns(self._loop_signs.still_ns)

    def _report_unsupervised(self) -> None:
        """Report that the supervisor is dead or stopped, so that nobody else could end the run."""
        what = (
            "left the run"
            if self._control.closed
            else "was stopped, as by Ctrl-Z, and could not end the run any more"
        )
        self._unsupervised = (
            f"the supervisor (process {self._job.supervisor}) {what}; the loop was asked to stop"
        )
        self._safe_stop.report(self._unsupervised, Severity.WARNING)

    def _request(self) -> Literal["stop", "cut"] | None:
        """Return what the terminal requests."""
        messages = self._control.receive()
        if any(isinstance(message, Cut) for message in messages):
            return "cut"
        return "stop" if messages else None

    def _how(self, ending: Ending, loop: subprocess.Popen[bytes]) -> str:
        """Return how the loop came to its end, and in which controller's code."""
        if ending == "cut":
            return "torque was cut on request"
        called = self._heartbeat.activity
        where = f" in {called}" if called else ""
        if self._killed == "hung":
            if self._halted:
                return f"the loop was stopped by a signal{where} and was killed"
            still = _duration(self._timeout_ns())
            return f"the loop stood still for more than {still}{where} and was killed{self._starved()}"
        if self._killed == "late":
            limit = _duration(self._job.plan.exit_timeout_ns)
            return f"the loop did not stop within {limit}{where} and was killed"
        return f"the loop's process ended by itself ({_manner(loop.returncode)}){where}"

    def _starved(self) -> str:
        """Return as a clause that a loop was ready to run and could not; empty where that is not known."""
        if self._starved_ns is None:
            return ""
        got = f"; it was ready to run, but got a processor for only {self._starved_ns / 1e6:.1f} ms of that"
        fix = "; loop.scheduler.policy round_robin lets it run before other programs"
        return got if self._job.plan.priority else got + fix


def _duration(time_ns: float) -> str:
    """Write a time in the unit that a person would take."""
    return f"{time_ns / 1e9:g} s" if time_ns >= 1e9 else f"{time_ns / 1e6:.0f} ms"


def _manner(code: int | None) -> str:
    """Return how a process ended."""
    if code is not None and code < 0:
        return f"signal {signal.Signals(-code).name}"
    return f"exit code {code}"


def main() -> None:
    """Run the guardian's process: `--job-fd N --control-fd M`."""
    job, control = process.begun(GuardianJob, _REQUESTS)
    try:
        Guardian(job, control).run()
    except PortError as error:
        control.send(Failed(str(error)))
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
