"""Logs of runs that are known to the last number."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
from msgspec import structs

from dxlrun.channels.cycle import CycleLayout, CycleRecord
from dxlrun.channels.event_records import EventBody, EventCode, EventRing, Severity
from dxlrun.channels.logged_packets import PacketBatch
from dxlrun.channels.ring import Handover, RecordKind
from dxlrun.log.log_writer import LogWriter
from dxlrun.log.schemas import LoggedController, LogHeader
from dxlrun_analysis.plan_excerpt import NO_LOOP
from dxlwire.clock import VirtualClock
from dxlwire.packets import PacketKind

PERIOD_NS = 20_000_000
JOINTS = ("left_elbow_joint", "head_yaw_joint")
PLAN = {
    "buses": [
        {
            "name": "main",
            "servos": [{"joint": j, "servo_id": i} for j, i in zip(JOINTS, (5, 21), strict=True)],
        }
    ]
}


def loop_of(**changed: object) -> object:
    """Return the loop of a plan as it is in a log, an empty one with something in it."""
    return msgspec.to_builtins(structs.replace(NO_LOOP, **changed))


@dataclass(frozen=True)
class Cycle:
    """One cycle of a made-up run; times in us."""

    number: int
    skipped: int = 0
    late: int = 0
    read: int = 5000
    update: int = 100
    write: int = 300
    position: float = 0.0
    goal: float = 0.0
    valid: bool = True
    clamped: int = 0


@dataclass(frozen=True)
class Wire:
    """One packet of a made-up run; times in us."""

    kind: PacketKind
    servo_id: int
    at: int
    data: bytes
    last: int | None = None


@dataclass(frozen=True)
class Said:
    """One event of a made-up run."""

    code: EventCode
    severity: Severity
    text: str
    source: str = "head"
    data: bytes = b""


def made_log(
    directory: Path,
    cycles: Sequence[Cycle] = (),
    wires: Sequence[Wire] = (),
    events: Sequence[Said] = (),
    *,
    gaps: int = 0,
    close: bool = True,
    plan: object = PLAN,
    metadata: dict[str, dict[str, str]] | None = None,
) -> Path:
    path = directory / "run.mcap"
    path.unlink(missing_ok=True)
    controllers = (LoggedController("head", JOINTS[1:], ()), LoggedController("idle", (), ()))
    attachments = {"plan.json": json.dumps(plan).encode()}
    header = LogHeader(
        "torso",
        JOINTS,
        ("main",),
        controllers,
        PERIOD_NS,
        0,
        attachments=attachments,
        metadata=metadata or {},
    )
    log = LogWriter(path, header)
    record = CycleRecord(CycleLayout(JOINTS, ["head", "idle"]))
    for cycle in cycles:
        fill(record, cycle)
        log.write_record(RecordKind.CYCLE, record.raw)
    batch = PacketBatch(Handover(log.write_record))
    for wire in wires:
        last = wire.at if wire.last is None else wire.last
        batch.packet(0, wire.kind, wire.servo_id, wire.at * 1000, last * 1000, wire.data)
    batch.commit_packets()
    ring = EventRing(Handover(log.write_record), VirtualClock(9))
    for said in events:
        ring.emit_event(said.source, EventBody(said.code, said.severity, said.text), said.data)
    if gaps:
        log.gap("loop/packets", gaps)
    if close:
        log.close()
    else:
        log.finish_chunk()
    return path


def fill(record: CycleRecord, cycle: Cycle) -> None:
    record.cycle, record.skipped = cycle.number, cycle.skipped
    record.scheduled_ns = 10**9 + cycle.number * PERIOD_NS
    record.woken_ns = record.scheduled_ns + cycle.late * 1000
    record.read_ns = record.woken_ns + cycle.read * 1000
    record.updated_ns = record.read_ns + cycle.update * 1000
    record.written_ns = record.updated_ns + cycle.write * 1000
    record.states.position[:] = [cycle.position, 1.0]
    record.valid[:] = [cycle.valid, True]
    record.age_ns[:] = [0 if cycle.valid else PERIOD_NS, 0]
    record.goals.position[0] = cycle.goal
    record.clamped[:] = [cycle.clamped, 0]
    record.controller_ns[:] = [cycle.update * 500, 0]
