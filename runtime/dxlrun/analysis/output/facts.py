"""What a log says about itself, as tables: which robot, which software, which wishes and what was granted."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime

import msgspec

from dxlrun.analysis.latency import on_virtual_time
from dxlrun.analysis.output.tables import Cell, Column, Table, tone_of
from dxlrun.analysis.report import Report
from dxlrun.errors import counted
from dxlrun.log.reader import UNREADABLE, Log
from dxlrun.run.channels.events import EventCode


class _Servo(msgspec.Struct):
    model: str = "?"


class _Bus(msgspec.Struct):
    name: str
    port: str = "?"
    protocol: float = 0.0
    baud_rate: int = 0
    servos: list[_Servo] = []


class _Plan(msgspec.Struct):
    buses: list[_Bus] = []


def began(log: Log) -> str:
    """Return the wall time of the first cycle, or of the first event, in UTC; empty where none is known."""
    times = log.cycles["scheduled_ns"][:1].tolist() or [event.t_ns for event in log.events[:1]]
    if not times or not log.header.epoch_offset_ns:
        return ""
    moment = datetime.fromtimestamp((times[0] + log.header.epoch_offset_ns) / 1e9, UTC)
    return f"{moment:%Y-%m-%d %H:%M:%S} UTC"


def facts(log: Log, report: Report) -> tuple[Table, ...]:
    """Return the tables of the run: robot, buses, real time, software."""
    found = (_run(log, report), _buses(log), _real_time(log), _software(log))
    return tuple(table for table in found if table.rows)


def _run(log: Log, report: Report) -> Table:
    account, run = report.periods, log.metadata.get("run", {})
    clock = "virtual: times are computed, not measured" if on_virtual_time(log) else run.get("clock", "")
    rows: list[tuple[str, str | Cell]] = [
        ("robot", report.robot),
        ("robot file", run.get("robot_file", "")),
        *((f"argument {name[9:]}", value) for name, value in run.items() if name.startswith("argument ")),
        ("began", began(log)),
        ("lasted", f"{account.seconds:.1f} s"),
        ("rate", f"{account.rate_hz:g} Hz, period {log.period_ns / 1e6:g} ms"),
        *(("rates", account.rates) for _ in account.rates_hz[1:2]),
        ("clock", clock),
        ("joints", str(len(log.joints))),
        ("controllers", ", ".join(controller.name for controller in log.controllers)),
        ("log", log.path.name),
        *(("damage", Cell(damage, "warning")) for damage in report.damage),
    ]
    return _pairs("Run", rows)


def _buses(log: Log) -> Table:
    try:
        plan = msgspec.json.decode(log.attachments.get("plan.json", b"{}"), type=_Plan)
    except UNREADABLE:
        plan = _Plan()  # a log without a readable plan still has buses, by name
    rows: list[tuple[str, str]] = []
    planned = {bus.name: bus for bus in plan.buses}
    for name in log.buses:
        bus = planned.get(name)
        if bus is None or not bus.protocol:
            rows.append((f"bus {name}", "nothing more is known"))
            continue
        models = sorted({servo.model for servo in bus.servos})
        rows.append(
            (
                f"bus {name}",
                f"port {bus.port}, Protocol {bus.protocol:.1f}, {bus.baud_rate / 1e6:g} Mbit/s, "
                f"{counted(len(bus.servos), 'servo', 'servos')} ({', '.join(models)})",
            )
        )
    return _pairs("Buses of the plan", rows)


def _real_time(log: Log) -> Table:
    """Return the wishes of the robot file, and what became of each."""
    wish = log.metadata.get("scheduler", {})
    rows: list[tuple[str, str | Cell]] = []
    if wish:
        locked = ", memory locked" if wish.get("lock_memory") == "true" else ""
        policy = wish.get("policy", "?")
        priority = f", priority {wish.get('priority', '?')}" if policy != "other" else ""
        cores = f", cores {wish['cores']}" if wish.get("cores") else ""
        awake = ", cores kept awake" if wish.get("idle_latency") == "true" else ""
        rows.append(("asked for", f"scheduler {policy}{priority}{locked}{cores}{awake}"))
    for event in log.events:
        if event.code == EventCode.SCHEDULER:
            tone = tone_of(event.severity)
            whom = " to the guardian" if event.source == "guardian" else ""
            rows.append((f"{'granted' if tone == 'plain' else 'not granted'}{whom}", Cell(event.text, tone)))
    return _pairs("Real time", rows)


def _software(log: Log) -> Table:
    kernel = log.metadata.get("kernel", {})
    system = " ".join(kernel.get(key, "") for key in ("system", "release", "version", "machine"))
    versions = log.metadata.get("versions", {})
    first = [name for name in ("dxlrun", "python") if name in versions]
    others = [name for name in versions if name not in first]
    rows = [
        ("kernel", system.strip()),
        *((name, versions[name]) for name in first),
        ("libraries", ", ".join(f"{name} {versions[name]}" for name in others)),
        *((f"{name}", source) for name, source in log.metadata.get("plugins", {}).items()),
    ]
    return _pairs("Software", rows)


def _pairs(title: str, rows: Iterable[tuple[str, str | Cell]]) -> Table:
    cells = [(Cell(name), value if isinstance(value, Cell) else Cell(value)) for name, value in rows]
    return Table(title, (Column("", "name"), Column("", "text")), tuple(row for row in cells if row[1].text))
