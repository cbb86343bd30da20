"""The processes of one run: simulated bus, recorder, guardian and, through it, the loop; in order."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

import msgspec

from dxlrun.compile.plan import Plan, to_json
from dxlrun.compile.simulation import simulated_bodies, simulated_buses
from dxlrun.control.realtime.grants import Grant, guardian_priority
from dxlrun.log.header import LogHeader
from dxlrun.remote.job import Descriptors, GatewayJob
from dxlrun.run.assembly import cycle_layout
from dxlrun.run.channels import heartbeat, mailbox, process, ring
from dxlrun.run.channels.child import Child
from dxlrun.run.channels.commands import COMMAND_SLOT, command_slots
from dxlrun.run.channels.cycle import MOST_CONTROLLERS, cycle_slots
from dxlrun.run.channels.events import EVENT_SLOT, event_slots
from dxlrun.run.channels.packets import PACKET_SLOT, packet_slots
from dxlrun.run.guardian import GuardianJob
from dxlrun.run.loop_process import LoopJob, Outcome
from dxlrun.simulation import SimulationConfig, encode_config

_GUARDIAN_SLOTS = 1024


@dataclass(frozen=True, slots=True)
class Memory:
    """Descriptors of everything that the processes of a run share; nameless, gone with the last of them."""

    plan: int
    heartbeat: int
    cycles: int
    packets: int
    desk: int
    events: int
    commands: int
    guardian_packets: int
    guardian_events: int
    result: int
    mailbox: int
    answers: int
    grants: int
    stderr: int

    @classmethod
    def create(cls, plan: Plan) -> Memory:
        """Create it all, rings sized for ten seconds of this robot."""
        servos = sum(len(bus.servos) for bus in plan.buses)
        period = plan.loop.period_ns
        return cls(
            plan=process.memory_file("dxlrun-plan", to_json(plan)),
            heartbeat=heartbeat.create(),
            cycles=ring.create("cycles", cycle_layout(plan).size, cycle_slots(period)),
            packets=ring.create("packets", PACKET_SLOT, packet_slots(period, servos)),
            desk=process.memory_file("dxlrun-desk", bytes(PACKET_SLOT + 64)),
            events=ring.create("events", EVENT_SLOT, event_slots(period, servos)),
            commands=ring.create("commands", COMMAND_SLOT, command_slots(period, len(plan.loop.controllers))),
            guardian_packets=ring.create("guardian-packets", PACKET_SLOT, _GUARDIAN_SLOTS),
            guardian_events=ring.create("guardian-events", EVENT_SLOT, _GUARDIAN_SLOTS),
            result=process.memory_file("dxlrun-result"),
            mailbox=mailbox.create(MOST_CONTROLLERS),
            answers=ring.create("answers", mailbox.ANSWER_SLOT, mailbox.ANSWER_SLOTS),
            grants=process.memory_file("dxlrun-grants"),
            stderr=process.memory_file("dxlrun-stderr"),
        )

    def outcome(self) -> Outcome | None:
        """Return what the loop's process left behind; None when it did not get to it."""
        try:
            return msgspec.json.decode(process.whole(self.result), type=Outcome)
        except msgspec.MsgspecError:  # nothing, or what was cut short
            return None

    def loop_grants(self) -> tuple[Grant, ...]:
        """Return what the operating system granted to the loop; nothing before it runs."""
        try:
            return msgspec.json.decode(process.whole(self.grants), type=tuple[Grant, ...])
        except msgspec.MsgspecError:
            return ()

    def rings(self) -> list[dict[str, object]]:
        """Return what the recorder reads, and from whom."""
        return [
            {"kind": "cycles", "fd": self.cycles, "source": "loop"},
            {"kind": "packets", "fd": self.packets, "source": "loop"},
            {"kind": "events", "fd": self.events, "source": "loop"},
            {"kind": "commands", "fd": self.commands, "source": "loop"},
            {"kind": "packets", "fd": self.guardian_packets, "source": "guardian"},
            {"kind": "events", "fd": self.guardian_events, "source": "guardian"},
        ]


def _ready(child: Child) -> Mapping[str, object]:
    """Return what a child says when it is ready; one that says something else does not outlive that."""
    try:
        return child.ready()
    except BaseException:
        child.kill()
        raise


def start_simulation(plan: Plan, ledger: Path | None, memory: Memory) -> tuple[Child, dict[str, str]]:
    """Start the simulated servos; return the process and the pseudo-terminal of each simulated bus.

    With a loop in real time they get a priority above loop and guardian, and the last core that the loop was
    not given: a servo's electronics do not wait for the host's processor.
    """
    told = SimulationConfig(simulated_buses(plan), bodies=simulated_bodies(plan))
    config = process.memory_file("dxlrun-simulation", encode_config(told))
    arguments = ["--config-fd", str(config)] + (["--ledger", str(ledger)] if ledger else [])
    scheduler = plan.loop.scheduler
    if scheduler.policy != "other":
        core = process.spare_core(scheduler.cores)
        arguments += ["--priority", str(min(scheduler.priority + 2, 99)), "--core", str(core)]
    child = Child("simulated bus", "dxlrun.simulation", arguments, [config], memory.stderr)
    os.close(config)
    return child, msgspec.convert(_ready(child)["ports"], type=dict[str, str])


def start_recorder(log: Path, header: LogHeader, memory: Memory) -> Child:
    """Start the recorder and wait until the log is open."""
    job = {"path": str(log), "header": header, "rings": memory.rings()}
    descriptor = process.memory_file("dxlrun-recorder", msgspec.json.encode(job))
    descriptors = [descriptor, *(int(str(one["fd"])) for one in memory.rings())]
    child = Child("recorder", "dxlrun.log", ["--job-fd", str(descriptor)], descriptors, memory.stderr)
    os.close(descriptor)
    _ready(child)
    return child


def start_gateway(log: Path | None, memory: Memory) -> Child:
    """Start the gateway; it says where its socket is when it is ready, nobody waits for it.

    Raises OSError when the system has no process left.
    """
    shared = Descriptors(
        memory.heartbeat,
        memory.cycles,
        memory.events,
        memory.guardian_events,
        memory.mailbox,
        memory.answers,
    )
    job = GatewayJob(memory.plan, shared, str(log.absolute()) if log else None)
    descriptor = process.memory_file("dxlrun-gateway", msgspec.json.encode(job))
    inherited = [descriptor, memory.plan, *astuple(shared)]
    try:
        return Child("gateway", "dxlrun.remote", ["--job-fd", str(descriptor)], inherited, memory.stderr)
    finally:
        os.close(descriptor)


def guardian_job(plan: Plan, ports: Mapping[str, str], memory: Memory, *, take_over: bool) -> GuardianJob:
    """Return what the guardian is to do, and through it the loop."""
    loop = LoopJob(
        memory.plan,
        memory.heartbeat,
        memory.cycles,
        memory.packets,
        memory.desk,
        memory.events,
        memory.commands,
        memory.result,
        memory.mailbox,
        memory.answers,
        memory.grants,
        take_over,
    )
    scheduler = plan.loop.scheduler
    return GuardianJob(
        buses=plan.buses,
        ports=tuple(ports.get(bus.name, bus.port) for bus in plan.buses),
        period_ns=plan.loop.period_ns,
        exit_timeout_ns=plan.exit_timeout_ns,
        priority=guardian_priority(scheduler),
        lock_memory=scheduler.lock_memory,
        heartbeat=memory.heartbeat,
        packets=memory.guardian_packets,
        events=memory.guardian_events,
        loop_packets=memory.packets,
        desk=memory.desk,
        stderr=memory.stderr,
        last=plan.loop.policies.on_fault.last,
        loop=msgspec.to_builtins(loop),
        loop_descriptors=(
            memory.plan,
            memory.heartbeat,
            memory.cycles,
            memory.packets,
            memory.desk,
            memory.events,
            memory.commands,
            memory.result,
            memory.mailbox,
            memory.answers,
            memory.grants,
            memory.stderr,
        ),
    )


def start_guardian(job: GuardianJob, others: Sequence[Child]) -> Child:
    """Start the guardian; `ready` then waits until it holds the ports and has executed the loop.

    It inherits our ends of the lines to `others`: should this process die, the simulated bus and the recorder
    see the end of their lines only after the guardian has made the robot limp.
    """
    descriptor = process.memory_file("dxlrun-guardian", msgspec.json.encode(job))
    inherited = [descriptor, job.packets, job.events, *job.loop_descriptors]
    inherited += [other.line.fileno() for other in others]
    child = Child("guardian", "dxlrun.run.guardian", ["--job-fd", str(descriptor)], inherited, job.stderr)
    os.close(descriptor)
    return child
