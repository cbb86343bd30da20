"""Changed copies of logs: what is not changed stays the same, bit for bit.

    write_changed(log, tmp_path / "changed.mcap", flip("goal_position", cycle=9, row=2), only(slice(20)))

A change maps the log that was read to the log that is written.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import structs

from dxlrun.channels.commands import CommandRing
from dxlrun.channels.event_records import EventBody, EventRing, Severity
from dxlrun.channels.ring import Handover, RecordKind
from dxlrun.channels.topic_messages import MessageRing, PublishedTopic
from dxlrun.log.log_reader import Log, read_log
from dxlrun.log.log_writer import LogWriter
from dxlwire.clock import VirtualClock

Change = Callable[[Log], Log]
OWN_METADATA, OWN_ATTACHMENT = ("dxlrun", "dxlrun_summary"), "header.json"


def write_changed(path: Path, target: Path, *changes: Change, gaps: Sequence[tuple[str, int]] = ()) -> Path:
    """Write a changed copy of a log to `target`; `gaps`: rings and how many records each of them lost."""
    log = read_log(path)
    for change in changes:
        log = change(log)
    header = structs.replace(
        log.header,
        attachments={name: data for name, data in log.attachments.items() if name != OWN_ATTACHMENT},
        metadata={name: record for name, record in log.metadata.items() if name not in OWN_METADATA},
    )
    target.unlink(missing_ok=True)
    writer = LogWriter(target, header)
    take = Handover(writer.write_record)
    if log.activation is not None:
        writer.write_record(RecordKind.CYCLE, log.activation.tobytes())
    for command in log.commands:
        CommandRing(take).record_command(command)
    for row in range(len(log.cycles)):
        writer.write_record(RecordKind.CYCLE, log.cycles[row : row + 1].tobytes())
    for event in log.events:
        ring = EventRing(take, VirtualClock(event.t_ns))
        ring.emit_event(event.source, EventBody(event.code, Severity(event.severity), event.text), event.data)
    published = MessageRing(take)
    for topic in log.topics.values():
        number = published.announce(PublishedTopic(topic.name, topic.type))
        for t_ns, data in zip(topic.t_ns.tolist(), topic.data, strict=True):
            published.message(number, t_ns, data)
    for source, lost in gaps:
        writer.gap(source, lost)
    writer.close()
    return target


def edited(edit: Callable[[Any], Any], of: str = "cycles") -> Change:
    """Let `edit` change the cycles in place, or the activation."""

    def change(log: Log) -> Log:
        rows = getattr(log, of).copy()
        edit(rows)
        return replace(log, **{of: rows})

    return change


def put(field: str, place: int | tuple[int | slice, int], value: object, of: str = "cycles") -> Change:
    """Put a value into a field of a cycle; `place`: its index, and the row of a joint."""
    return edited(lambda cycles: cycles[field].__setitem__(place, value), of)


def add(field: str, place: int | tuple[int, int], value: float) -> Change:
    """Add a value to a field of a cycle."""
    return edited(lambda cycles: cycles[field].__setitem__(place, cycles[field][place] + value))


def flip(field: str, cycle: int, row: int, bit: int = 0) -> Change:
    def edit(cycles: Any) -> None:
        cycles[field][cycle].view(np.uint64)[row] ^= np.uint64(1 << bit)

    return edited(edit)


def only(rows: slice) -> Change:
    """Keep some cycles."""
    return lambda log: replace(log, cycles=log.cycles[rows])


def without(*rows: int) -> Change:
    """Leave out cycles."""
    return lambda log: replace(log, cycles=np.delete(log.cycles, rows))


def command(which: str, number: int = 0, **other: Any) -> Change:
    """Change the first command of a kind, or the one of that number."""

    def change(log: Log) -> Log:
        commands = list(log.commands)
        index = [place for place, one in enumerate(commands) if one.kind == which][number]
        commands[index] = structs.replace(commands[index], **other)
        return replace(log, commands=tuple(commands))

    return change


def no_commands(kind: str | None = None) -> Change:
    """Leave out all commands, or those of a kind."""
    return lambda log: replace(
        log, commands=tuple(one for one in log.commands if kind not in (None, one.kind))
    )


def plan(edit: Callable[[Any], Any] | bytes | None) -> Change:
    """Let `edit` change the plan in place; or put other bytes in its place, None: nothing."""

    def change(log: Log) -> Log:
        data = edit if isinstance(edit, bytes) else b""
        if callable(edit):
            content = json.loads(log.attachments["plan.json"])
            edit(content)
            data = json.dumps(content).encode()
        others = {name: one for name, one in log.attachments.items() if name != "plan.json"}
        return replace(log, attachments=others | ({} if edit is None else {"plan.json": data}))

    return change


def plan_text(*pairs: tuple[bytes, bytes]) -> Change:
    """Replace bytes of the plan."""

    def change(log: Log) -> Log:
        data = log.attachments["plan.json"]
        for old, new in pairs:
            assert old in data
            data = data.replace(old, new)
        return replace(log, attachments=log.attachments | {"plan.json": data})

    return change


def versions(**other: str) -> Change:
    """Let the run have had other versions."""
    return lambda log: replace(log, metadata=log.metadata | {"versions": log.metadata["versions"] | other})


def messages(topic: str, edit: Callable[[list[tuple[int, bytes]]], Any]) -> Change:
    """Let `edit` change the messages of a topic, each with its time, in place."""

    def change(log: Log) -> Log:
        of_it = log.topics[topic]
        found = list(zip(of_it.t_ns.tolist(), of_it.data, strict=True))
        edit(found)
        times, data = np.array([t_ns for t_ns, _ in found], np.int64), tuple(one for _, one in found)
        return replace(log, topics={**log.topics, topic: structs.replace(of_it, t_ns=times, data=data)})

    return change
