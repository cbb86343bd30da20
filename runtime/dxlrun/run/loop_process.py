"""Loop process: plug-ins, set-up on the bus, real time, the loop, torque off.

One thread in a newly executed process (no fork), on file descriptors that the guardian opened. SIGTERM asks
it to stop; the guardian sends it, or the Linux kernel when the guardian has exited. The loop ends
independently when neither supervisor nor guardian responds (`watch.py`).
"""

from __future__ import annotations

import os
import select
import signal
import socket
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import msgspec
from msgspec import structs
from msgspec.json import Decoder

from dxlrun.channels import child_processes
from dxlrun.channels.child_processes import LineLost, LineReturned, MessageChannel
from dxlrun.channels.commands import CommandRing
from dxlrun.channels.event_records import EventRing, EventSink, SimulationStall
from dxlrun.channels.heartbeat import GatewayAvailability, Heartbeat, Phase
from dxlrun.channels.kept import KeptStates
from dxlrun.channels.logged_packets import PacketBatch
from dxlrun.channels.mailbox import Mailbox
from dxlrun.channels.ring import RingWriter
from dxlrun.channels.shared_memory import mapped
from dxlrun.channels.topic_messages import MessageRing
from dxlrun.control import realtime_grants
from dxlrun.control.context import StopFlag
from dxlrun.control.controllers.activity import Activity
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.control.realtime_grants import Pacing
from dxlrun.dynamixel.dynamixel_hardware import TAKEN_BACK
from dxlrun.errors import DxlrunError, PlugInError, StartUpError, counted
from dxlrun.plan.loop_plan import SchedulerPlan
from dxlrun.plan.machine_load import SimulationWait
from dxlrun.plan.policy_plan import TORQUE_STAYS
from dxlrun.plan.robot_plan import Plan, from_json
from dxlrun.run import texts
from dxlrun.run.assembly import LoopHost, Sinks, assemble
from dxlrun.run.guardian import LoopJob, LoopOutcome, make_ports
from dxlrun.run.process_watch import Duty, LoopWatch
from dxlwire.clock import MonotonicClock
from dxlwire.port.ports import (
    MOST_SHARE,
    ReplyPolling,
    SerialPorts,
    StallCounter,
)


def _keep_to_this_process(descriptors: Sequence[int]) -> None:
    """Close ports and the guardian's channel in child processes that plug-ins start.

    A child with a port could write to the servos, and would hold the port's lock after the run. A forked
    child also gets the default action of SIGTERM back, because only the loop reads the stop flag. It keeps
    mapped memory.
    """
    for descriptor in descriptors:
        os.set_inheritable(descriptor, False)

    def let_go() -> None:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        for descriptor in descriptors:
            with suppress(OSError):
                os.close(descriptor)

    os.register_at_fork(after_in_child=let_go)


def _looked_at(heartbeat: Heartbeat) -> Callable[[str], None]:
    """Return a function to call after each import of a plug-in, which refuses new threads.

    The function beats the heartbeat, since an import takes time. It raises PlugInError when the newest
    plug-in left a thread, and exits a forked child that returned from the import, which would run a second
    loop.
    """
    before, own = realtime_grants.thread_count(), os.getpid()

    def check_import(name: str) -> None:
        nonlocal before
        if os.getpid() != own:
            # A child that was forked during an import has returned.
            os._exit(0)
        heartbeat.beat()
        more, before = realtime_grants.thread_count() - before, max(before, realtime_grants.thread_count())
        if more > 0:
            raise PlugInError(
                f"plug-in {name} started {counted(more, 'more thread', 'more threads')} in the loop's "
                "process, which delay its cycles; start no threads there, or start a separate process"
            )

    return check_import


# No reply was late for this time, so the simulation responds again.
_WAIT_OVER_NS = 20_000_000
# Shortest interval between two events, when most replies are late.
_WAITS_EVENT_NS = 1_000_000_000


class LineReopener:
    """Asks the guardian to reopen lost bus lines; the `reopened` of `SerialPorts`."""

    def __init__(self, channel: MessageChannel[LineReturned]) -> None:
        self._channel = channel
        self._asked: set[int] = set()
        self._came: dict[int, int] = {}

    def __call__(self, index: int) -> int | None:
        """Return the file descriptor of a line that is open again, once; None until then. Does not block."""
        if index not in self._asked:
            self._asked.add(index)
            self._channel.send_message(LineLost(index))
        if not self._channel.closed and select.select([self._channel], [], [], 0)[0]:
            for message in self._channel.receive_messages():
                self._came[message.bus] = self._channel.descriptors.pop(0)
        descriptor = self._came.pop(index, None)
        if descriptor is not None:
            self._asked.remove(index)
        return descriptor


class StopRequest(Exception):
    """Raised during set-up after a stop request: torque must not be switched on any more."""


class StallReport:
    """Logs events about waits for simulated servos, at most one per second."""

    def __init__(self, stalls: StallCounter, events: EventSink) -> None:
        self._stalls = stalls
        self._events = events
        self._reported_ns = self._reported_times = 0
        # Total wait at the last check.
        self._seen_ns = 0
        # Time at which the total last increased.
        self._grew_ns = 0
        self._emitted_ns = 0

    @property
    def total(self) -> SimulationWait:
        """Duration and number of all waits since the start."""
        return SimulationWait(self._stalls.waited_ns, self._stalls.times)

    def report_waits(self, now_ns: int) -> None:
        """Emit an event about new waits when they are over. Called at each heartbeat."""
        if self._stalls.times == self._reported_times and self._stalls.waited_ns == self._reported_ns:
            return
        if self._stalls.waited_ns != self._seen_ns:
            self._seen_ns, self._grew_ns = self._stalls.waited_ns, now_ns
        if now_ns - self._grew_ns >= _WAIT_OVER_NS and now_ns - self._emitted_ns >= _WAITS_EVENT_NS:
            self._emitted_ns = now_ns
            self.emit_waits()

    def emit_waits(self) -> None:
        """Emit an event with the waits since the last event, if there were any."""
        total = self.total
        since = SimulationWait(total.waited_ns - self._reported_ns, total.times - self._reported_times)
        if since.waited_ns or since.times:
            self._reported_ns, self._reported_times = total.waited_ns, total.times
            data = msgspec.json.encode(SimulationStall(since.waited_ns, since.times))
            self._events.emit_event("machine", texts.simulation_stalled(since.clause), data)


@dataclass(slots=True)
class Pulse:
    """Supervision of a loop from inside its process, see `control.context.Supervision`.

    `beat` is called during waits for replies and once per cycle. It checks supervisor and guardian, reports
    waits for simulated servos, and aborts a set-up on a stop request.
    """

    heartbeat: Heartbeat
    stop: StopFlag
    watch: LoopWatch
    events: EventSink
    stalls: StallReport
    now_ns: Callable[[], int]
    pacing: Pacing | None = None
    """Sets the polling time of the clock; None when the clock does not poll."""

    def beat(self) -> None:
        """Send a heartbeat, and request a stop if supervisor and guardian are gone.

        Raises AskedToStop, once, and only during set-up: the running loop reads the stop flag.
        """
        self.heartbeat.beat()
        now_ns = self.now_ns()
        self.stalls.report_waits(now_ns)
        if not self.stop.requested and self.watch.duty(now_ns) is Duty.END:
            self.stop.request()
            self.events.emit_event("loop", texts.loop_unwatched())
        if self.stop.requested and self.heartbeat.phase in (Phase.SETUP, Phase.ENGAGING):
            self.heartbeat.enter_phase(Phase.STOPPING)
            raise StopRequest

    def limit_cycle(self, limit_ns: int) -> None:
        """Set the guardian's timeout for each cycle, ns."""
        self.heartbeat.may_take(limit_ns)

    def set_period(self, period_ns: int) -> None:
        """Adapt the polling of the clock, a small share of the period, to a new period."""
        if self.pacing is not None:
            self.pacing.set_period(period_ns)


def _reply_polling(longest_ns: int | None) -> ReplyPolling | None:
    if longest_ns is None:
        return ReplyPolling()
    return ReplyPolling(longest_ns, MOST_SHARE) if longest_ns else None


def beside_simulation(plan: Plan) -> SchedulerPlan:
    """Return the scheduler plan of the loop without the core that simulated servos use."""
    scheduler = plan.loop.scheduler
    others = os.sched_getaffinity(0) - {child_processes.spare_core(())}
    if scheduler.policy == "other" or scheduler.cores or not others:
        return scheduler
    simulated = any(bus.port == "sim" for bus in plan.buses)
    return structs.replace(scheduler, cores=tuple(sorted(others))) if simulated else scheduler


def _run(plan: Plan, job: LoopJob, heartbeat: Heartbeat, sinks: Sinks, stalls: StallCounter) -> LoopOutcome:
    """Run the loop's process from the import of plug-ins to torque off; return its result."""
    stop = StopFlag()
    signal.signal(signal.SIGTERM, lambda *_: stop.request())
    ports = SerialPorts(
        make_ports(plan.buses, job.ports, job.memory, stalls),
        LineReopener(MessageChannel(socket.socket(fileno=job.channel), Decoder(LineReturned))),
        _reply_polling(plan.loop.scheduler.reply_polling_ns),
    )
    report = StallReport(stalls, sinks.events)
    clock = MonotonicClock()
    pacing = Pacing(clock, plan.loop.scheduler.polling_ns)
    watch = LoopWatch(heartbeat, job.supervisor, job.guardian, plan.loop.period_ns, clock.now_ns())
    plugins = load_plugins(_looked_at(heartbeat), plan.included)
    # Only a client can load a controller while the loop runs.
    if heartbeat.steering is not GatewayAvailability.IMPOSSIBLE:
        plugins.import_all()
    host = LoopHost(
        ports=ports,
        clock=clock,
        sinks=sinks,
        supervision=Pulse(heartbeat, stop, watch, sinks.events, report, clock.now_ns, pacing),
        inbox=Mailbox(job.memory.mailbox, RingWriter(job.memory.answers)),
        activity=Activity(heartbeat, realtime_grants.thread_count),
        slots={name: [mapped(one) for one in slots] for name, slots in job.memory.slots.items()},
    )
    kept = msgspec.json.decode(child_processes.whole(job.memory.kept), type=KeptStates)
    robot = assemble(plan, plugins, host, take_over=job.take_over, kept=kept)
    # Servos that are taken over may have torque already.
    heartbeat.enter_phase(Phase.ENGAGING if job.take_over else Phase.SETUP)
    # Before any servo has torque, because it takes a while, and a Bus Watchdog expects the first cycle in
    # time.
    _prepare(plan, job, heartbeat, sinks.events, pacing)
    if ports.polling:
        ports.polling.margin_ns = pacing.measured_ns
    try:
        try:
            result = robot.run(heartbeat.enter_phase)
        finally:
            report.emit_waits()
    except StopRequest as asked:
        sinks.events.emit_event("loop", texts.set_up_aborted())
        notes: list[str] = getattr(asked, "__notes__", [])
        return LoopOutcome("stopped", sentences=tuple(note for note in notes if note != TAKEN_BACK))
    detail = (result.detail,) if result.detail else ()
    remarks = (TORQUE_STAYS,) if result.last == "hold" else ()
    return LoopOutcome(
        result.reason,
        result.cycles,
        result.skipped,
        (*detail, *robot.failures),
        remarks,
        invalid=result.invalid,
        paused=result.paused,
        outside=result.outside,
    )


def _prepare(plan: Plan, job: LoopJob, heartbeat: Heartbeat, events: EventSink, pacing: Pacing) -> None:
    """Apply real-time settings, measure the wake-up delay of sleeps, and log the results."""
    grants = realtime_grants.apply_scheduler(beside_simulation(plan))
    heartbeat.beat()
    grants = (*grants, pacing.measure_margin(plan.loop.period_ns, heartbeat.beat))
    realtime_grants.log_grants(grants, "loop", events)
    os.pwrite(job.memory.grants, msgspec.json.encode(grants), 0)
    heartbeat.beat()


def main() -> None:
    """Run the loop's process: `--job JSON`."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    child_processes.hold_foreign_code(signal.SIGTERM)
    job = msgspec.json.decode(sys.argv[2], type=LoopJob)
    _keep_to_this_process((*job.memory.of_loop, *job.ports, job.channel))
    clock = MonotonicClock()
    heartbeat = Heartbeat(job.memory.heartbeat)
    happened = RingWriter(job.memory.events)
    events = EventRing(happened, clock)
    packets = PacketBatch(RingWriter(job.memory.packets), mapped(job.memory.desk))
    sinks = Sinks(
        RingWriter(job.memory.cycles),
        packets,
        events,
        CommandRing(happened),
        heartbeat.cycle,
        MessageRing(RingWriter(job.memory.messages)),
        job.epoch_offset_ns,
    )
    stalls = StallCounter()
    try:
        if os.getppid() != job.guardian:
            # The guardian exited before its death could be signalled.
            sys.exit(1)
        plan = from_json(child_processes.whole(job.memory.plan))
        events.goals.planned = plan.loop.origins
        outcome = _run(plan, job, heartbeat, sinks, stalls)
        outcome = structs.replace(outcome, events=events.totals)
    except DxlrunError as error:
        for_replies = isinstance(error, StartUpError) and error.for_replies
        outcome = LoopOutcome("start-up", sentences=error.sentences, refused_for_replies=for_replies)
        events.emit_event("loop", texts.start_refused(error.sentences))
    # Last resort: the run ends with a sentence, and the log has the traceback.
    except Exception as error:
        sentence = f"dxlrun itself failed: {type(error).__name__}: {error}; run with --debug for details"
        outcome = LoopOutcome("fault", sentences=(sentence,), traceback=traceback.format_exc())
        sys.stderr.write(outcome.traceback)
        events.emit_event("loop", texts.loop_crashed(outcome.traceback))
    outcome = structs.replace(outcome, simulation_wait=SimulationWait(stalls.waited_ns, stalls.times))
    sinks.packets.commit_packets()
    os.pwrite(job.memory.result, msgspec.json.encode(outcome), 0)
    if not outcome.traceback:
        heartbeat.enter_phase(Phase.DONE)
    sys.exit(0 if outcome.reason in ("ended", "stopped") and not outcome.sentences else 1)


if __name__ == "__main__":
    main()
