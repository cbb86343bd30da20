"""Run processes: create the shared memory of a run, and start each of its processes."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterable, Mapping
from dataclasses import astuple
from pathlib import Path
from typing import NamedTuple, TypeVar

import msgspec
from msgspec.json import Decoder

from dxlrun.channels import child_processes, heartbeat, mailbox, ring, shared_memory, slot
from dxlrun.channels.child_processes import Child, Draining, Failed, Listening, Ready, RunMemory
from dxlrun.channels.commands import LONGEST_COMMAND, command_capacity
from dxlrun.channels.cycle import MOST_CONTROLLERS, cycle_capacity
from dxlrun.channels.event_records import LONGEST_EVENT, event_capacity
from dxlrun.channels.kept import LONGEST_FILE, KeptStates
from dxlrun.channels.logged_packets import DESK_SIZE, LONGEST_BATCH, packet_capacity
from dxlrun.channels.topic_messages import LONGEST_RECORD, message_capacity, usual_message
from dxlrun.compile.simulation import sensed_bodies, simulation_of
from dxlrun.control.realtime_grants import Grant, guardian_priority, raise_share
from dxlrun.control.sampled_sources import PlannedProcess, planned_processes
from dxlrun.log.schemas import LogClosed, LogHeader, RecorderJob
from dxlrun.plan.robot_plan import Plan, to_json
from dxlrun.process_table import KIND
from dxlrun.remote.job import Descriptors, GatewayJob
from dxlrun.run.guardian import GuardianJob, GuardianMessage, GuardianPlan, LoopOutcome
from dxlrun.run.simulation_front import first_message, start_simulation
from dxlrun.run.source_process import SourceJob
from dxlsim.messages import SimulationJob, SimulationMessage
from dxlwire.bus_plan import SIMULATED

SourceMessage = Ready | Failed
RecorderMessage = Ready | Draining | Failed | LogClosed
GatewayMessage = Listening | Failed

Message = TypeVar("Message")

RECORDER_NICE = -10
"""nice(2) value of the recorder; nine times the share of an ordinary program (sched(7)). The recorder needs a
tenth of a core at 1 kHz."""
_GUARDIAN_CAPACITY = 2 << 20
"""Size of the guardian's ring, bytes; it exchanges few packets and reports few events."""
_LONGEST_TAKEN = LONGEST_COMMAND + 64
"""Longest record of an executed command, bytes."""


def create_memory(plan: Plan, kept: KeptStates | None = None) -> RunMemory:
    """Create the memory of a run, with rings for ten seconds of this robot.

    `kept`: states that controllers kept in earlier runs. Raises NotCompiled when the shared memory module was
    not compiled.
    """
    shared_memory.library()
    servos = sum(len(bus.servos) for bus in plan.buses)
    simulated = sum(bus.port == SIMULATED for bus in plan.buses)
    sensed = sensed_bodies(plan)
    period, cycle = plan.loop.period_ns, plan.loop.layout.size
    events = event_capacity(period, servos + len(plan.loop.sources)) + command_capacity(
        period, len(plan.loop.controllers), mailbox.capacity(MOST_CONTROLLERS)
    )
    return RunMemory(
        plan=child_processes.memory_file("dxlrun-plan", to_json(plan)),
        heartbeat=heartbeat.create(),
        cycles=ring.create("cycles", cycle_capacity(period, cycle), cycle),
        packets=ring.create("packets", packet_capacity(period, servos), LONGEST_BATCH),
        desk=child_processes.memory_file("dxlrun-desk", bytes(DESK_SIZE)),
        events=ring.create("events", events, max(_LONGEST_TAKEN, LONGEST_EVENT)),
        messages=ring.create(
            "messages", message_capacity(_published(plan)) + 2 * LONGEST_FILE, LONGEST_RECORD
        ),
        guardian=ring.create("guardian", _GUARDIAN_CAPACITY, max(LONGEST_BATCH, LONGEST_EVENT)),
        result=child_processes.memory_file("dxlrun-result"),
        mailbox=mailbox.create(MOST_CONTROLLERS),
        answers=ring.create("answers", mailbox.ANSWERS_CAPACITY, mailbox.LONGEST_ANSWER),
        grants=child_processes.memory_file("dxlrun-grants"),
        stderr=child_processes.memory_file("dxlrun-stderr"),
        kept=child_processes.memory_file("dxlrun-kept", msgspec.json.encode(kept or KeptStates())),
        span=child_processes.memory_file("dxlrun-span"),
        slots=_create_slots(plan),
        shafts=slot.create("shafts", 3 * sensed.servos) if sensed is not None else -1,
        simulation=heartbeat.create_progress(simulated) if simulated else -1,
    )


def _create_slots(plan: Plan) -> dict[str, tuple[int, ...]]:
    slots: dict[str, tuple[int, ...]] = {}
    for one in planned_processes(plan.loop):
        process, name = one.process, one.feature.name
        created = slot.create(f"{process.kind}-{process.source}", process.values)
        slots[name] = (*slots.get(name, ()), created)
    return slots


def _published(plan: Plan) -> float:
    """Return how many bytes per second controllers publish, with one message per topic and update."""
    return sum(
        len(one.topics) * usual_message(len(one.joints)) * 1e9 / (plan.loop.period_ns * one.every)
        for one in plan.loop.controllers
    )


def loop_outcome(memory: RunMemory) -> LoopOutcome | None:
    """Read the result of the loop's process from the run's memory; None when it wrote none."""
    try:
        return msgspec.json.decode(child_processes.whole(memory.result), type=LoopOutcome)
    # The result is missing or truncated.
    except msgspec.MsgspecError:
        return None


def loop_grants(memory: RunMemory) -> tuple[Grant, ...]:
    """Read the results of the loop's real-time requests; empty before the loop runs."""
    try:
        return msgspec.json.decode(child_processes.whole(memory.grants), type=tuple[Grant, ...])
    except msgspec.MsgspecError:
        return ()


def start_simulated_buses(
    plan: Plan, ledger: Path | None, memory: RunMemory
) -> tuple[Child[SimulationMessage], dict[str, int]]:
    """Start the simulated servos; return the process, and a descriptor of the socket to each bus by name.

    A run has no terminal for them: no other program can open its buses.

    With a real-time loop, the process gets a priority above loop and guardian, and the last core that is not
    the loop's: a servo's electronics do not wait for the host's processor.
    """
    scheduler = plan.loop.scheduler
    real_time = (
        (min(scheduler.priority + 2, 99), child_processes.spare_core(scheduler.cores))
        if scheduler.policy != "other"
        else (0, -1)
    )
    config = simulation_of(plan)
    pairs = [socket.socketpair() for _ in config.buses]
    job = SimulationJob(
        config,
        str(ledger) if ledger else None,
        *real_time,
        memory.shafts,
        memory.simulation,
        tuple(theirs.fileno() for _, theirs in pairs),
    )
    child = start_simulation(job, memory.stderr)
    try:
        first_message(child)
    except BaseException:
        child.kill()
        raise
    for _, theirs in pairs:
        theirs.close()
    return child, {bus.name: ours.detach() for bus, (ours, _) in zip(config.buses, pairs, strict=True)}


def start_source(
    plan: Plan, planned: PlannedProcess, memory: RunMemory, *, restarted: bool = False
) -> Child[SourceMessage]:
    """Start a source process of a feature; its `ready` then waits until the source is open."""
    bodies = sensed_bodies(plan) if planned.process.has_body else None
    slot_of = memory.slots[planned.feature.name][planned.index]
    job = SourceJob(planned.feature, planned.process, slot_of, os.getpid(), restarted, bodies, memory.shafts)
    inherited = [job.slot, *([job.shafts] if bodies is not None else [])]
    role = (KIND, planned.process.kind)
    program = ProcessModule(planned.process.title, "dxlrun.run.source_process", role)
    return _executed(program, job, inherited, memory, Decoder(SourceMessage))


def start_recorder(log: Path, header: LogHeader, memory: RunMemory, plan: Plan) -> Child[RecorderMessage]:
    """Start the recorder and wait until the log is open.

    With a real-time loop, the recorder gets a larger share of the processor, so that other programs do not
    delay it. With an ordinary loop it does not, because it would then delay the loop.
    """
    job = RecorderJob(str(log), header, memory.recorded, plan.recording, memory.span)
    child: Child[RecorderMessage] = _executed(
        ProcessModule("recorder", "dxlrun.log.recorder"),
        job,
        (*memory.recorded.values(), memory.span),
        memory,
        Decoder(RecorderMessage),
    )
    if plan.loop.scheduler.policy != "other":
        raise_share(child.process.pid, RECORDER_NICE)
    try:
        child.ready()
    except BaseException:
        child.kill()
        raise
    return child


def start_gateway(
    log: Path | None, memory: RunMemory, epoch_offset_ns: int, listen: str
) -> Child[GatewayMessage]:
    """Start the gateway without waiting; it reports its socket when it is ready.

    Raises OSError when the system cannot create a process.
    """
    shared = Descriptors(
        memory.heartbeat,
        memory.cycles,
        memory.events,
        memory.guardian,
        memory.mailbox,
        memory.answers,
        memory.messages,
    )
    job = GatewayJob(memory.plan, shared, str(log.absolute()) if log else None, epoch_offset_ns, listen)
    inherited = [memory.plan, *astuple(shared)]
    return _executed(
        ProcessModule("gateway", "dxlrun.remote"), job, inherited, memory, Decoder(GatewayMessage)
    )


def guardian_job(
    plan: Plan,
    sockets: Mapping[str, int],
    memory: RunMemory,
    *,
    take_over: bool,
    epoch_offset_ns: int = 0,
) -> GuardianJob:
    """Return the job of the guardian, from which it makes the job of the loop."""
    scheduler = plan.loop.scheduler
    share = GuardianPlan(
        buses=plan.buses,
        features=plan.features,
        feature_plans=plan.feature_plans,
        period_ns=plan.loop.period_ns,
        exit_timeout_ns=plan.exit_timeout_ns,
        priority=guardian_priority(scheduler),
        lock_memory=scheduler.lock_memory,
        last=plan.loop.policies.on_fault.last,
    )
    return GuardianJob(share, memory, sockets, os.getpid(), take_over, epoch_offset_ns)


def start_guardian(job: GuardianJob, others: Iterable[int]) -> Child[GuardianMessage]:
    """Start the guardian; `ready` then waits until it holds the ports and has executed the loop.

    The guardian inherits `others`, our ends of the channels to simulated bus and recorder. If this process
    dies, these processes see their channels close only after the guardian has made the robot safe.
    """
    memory = job.memory
    sockets = job.sockets.values()
    inherited = [memory.guardian, memory.stderr, *memory.of_loop, *sockets, *others]
    program = ProcessModule("guardian", "dxlrun.run.guardian")
    try:
        return _executed(program, job, inherited, memory, Decoder(GuardianMessage))
    finally:
        for descriptor in sockets:
            os.close(descriptor)


class ProcessModule(NamedTuple):
    """Module that a process of a run executes."""

    name: str
    """Name of the process in messages."""
    module: str
    arguments: tuple[str, ...] = ()


def _executed(
    program: ProcessModule,
    job: object,
    inherited: Iterable[int],
    memory: RunMemory,
    messages: Decoder[Message],
) -> Child[Message]:
    """Start a process of a run, which reads its job as JSON from an inherited descriptor."""
    descriptor = child_processes.memory_file(f"dxlrun-{program.name}", msgspec.json.encode(job))
    arguments = ["--job-fd", str(descriptor), *program.arguments]
    try:
        # Each process inherits the plan's memory, by which the process table finds the processes of a run.
        shared = {descriptor, memory.plan, *inherited}
        return Child(program.name, program.module, arguments, sorted(shared), memory.stderr, messages)
    finally:
        os.close(descriptor)
