"""The log of a measurement: an MCAP file as those of runs, with a topic of wake-ups for each condition.

`dxlrun analyze` computes the same tables from it; other tools plot the topics `/latency/CONDITION`.
"""

from __future__ import annotations

import platform
import struct
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from dxlrun.channels.messages import MessageRing, Topic
from dxlrun.channels.ring import Handover
from dxlrun.errors import LogError
from dxlrun.log.log_writer import LogWriter
from dxlrun.log.reader import Log, LogReader
from dxlrun.log.schemas import LogHeader, LogSummary
from dxlrun.messages import Number
from dxlrun.messages.cdr import ENCAPSULATION
from dxlrun.messages.declared import declared_message
from dxlrun.run.run_log import epoch_offset_ns
from dxlrun_analysis.latency.conditions import Settings
from dxlrun_analysis.latency.statistics import Block, Result, figures

ROBOT = "latency"
"""Stands where the logs of runs have the robot's name."""
METADATA_NAME = "latency"
"""The metadata record that makes a log one of a measurement."""
_TOPIC = "/latency/"
_PACKAGE = "dxlrun_msgs"
_AT_ONCE = 10_000
"""Wake-ups that become Python's integers at a time: ten millions of them take over a gigabyte."""
_LIBRARIES = ("dxlrun", "mcap", "numpy")


@dataclass(slots=True)
class WakeUp:
    """One wake-up: when it was due and when it came, ns of the monotonic clock, and in which block."""

    scheduled_ns: int
    woken_ns: int
    block: Annotated[int, Number("int32")]


_ROW = struct.Struct("<qqi")
_ROWS = np.dtype([("head", "V4"), ("scheduled_ns", "<i8"), ("woken_ns", "<i8"), ("block", "<i4")])
"""A message as it is in the log; a test compares it with the declared one."""


class About(msgspec.Struct, frozen=True):
    """What the log says about the measurement beside its wake-ups."""

    settings: Settings
    load: str
    remarks: tuple[str, ...]
    processes: tuple[tuple[str, int, int, int, int], ...]
    """Of each block: condition, number, processor time, time that passed, polled time; ns."""


def write(
    path: Path, settings: Settings, blocks: Sequence[Block], load: str, remarks: Sequence[str]
) -> LogSummary:
    """Write the log of what was measured into a new or empty file. Raises OSError where it cannot begin."""
    processes = tuple((one.condition, one.number, one.cpu_ns, one.wall_ns, one.margin_ns) for one in blocks)
    about = About(settings, load, tuple(remarks), processes)
    here = platform.uname()
    header = LogHeader(
        robot=ROBOT,
        joints=(),
        buses=(),
        controllers=(),
        period_ns=settings.period_ns,
        epoch_offset_ns=epoch_offset_ns(),
        metadata={
            METADATA_NAME: {"about": msgspec.json.encode(about).decode()},
            "versions": {"python": sys.version.split()[0]} | {name: version(name) for name in _LIBRARIES},
            "kernel": {"system": here.system, "release": here.release, "version": here.version}
            | {"machine": here.machine},
        },
    )
    log = LogWriter(path, header)
    ring = MessageRing(Handover(log.take))
    kind = declared_message(WakeUp, _PACKAGE).type
    topics = {one.name: ring.announce(Topic(f"{_TOPIC}{one.name}", kind)) for one in settings.conditions}
    for block in blocks:
        topic = topics[block.condition]
        for begin in range(0, len(block.times), _AT_ONCE):
            for scheduled_ns, woken_ns in block.times[begin : begin + _AT_ONCE].tolist():
                ring.message(topic, woken_ns, ENCAPSULATION + _ROW.pack(scheduled_ns, woken_ns, block.number))
    return log.close()


def machine() -> str:
    """Return this machine in words, for a report."""
    here = platform.uname()
    return f"{here.system} {here.release}, {here.version}, {here.machine}"


def machine_of(log: Log) -> str:
    """Return the machine on which a log was made."""
    kernel = log.metadata.get("kernel", {})
    system = f"{kernel.get('system', '')} {kernel.get('release', '')}".strip()
    return ", ".join(filter(None, (system, kernel.get("version"), kernel.get("machine"))))


def is_measurement(reader: LogReader | Log) -> bool:
    """Return whether a log is one of `dxlrun latency`, by its first slice. Raises LogError."""
    first = next(iter(reader.slices()), None) or reader.about
    return METADATA_NAME in first.metadata


def measurement(log: Log) -> tuple[tuple[Block, ...], Result]:
    """Return blocks and statistics of a measurement's log. Raises LogError where it is damaged."""
    try:
        about = msgspec.json.decode(log.metadata[METADATA_NAME]["about"], type=About)
        blocks = tuple(_blocks(log, about))
    except (KeyError, ValueError, msgspec.MsgspecError) as error:
        raise LogError(f"{log.path}: the log of a measurement that cannot be read: {error}") from error
    result = figures(about.settings, blocks, about.load, (*about.remarks, *log.damage))
    if not result.conditions:
        raise LogError("; ".join((f"{log.path}: the log has no wake-up", *log.damage)))
    return blocks, result


def _blocks(log: Log, about: About) -> list[Block]:
    found = []
    topics = {
        condition.name: log.topics.get(f"{_TOPIC}{condition.name}") for condition in about.settings.conditions
    }
    # a topic is in a log from its first message on: that of a full disk may lack it
    rows = {name: _rows(topic.data if topic else ()) for name, topic in topics.items()}
    for name, number, cpu_ns, wall_ns, margin_ns in about.processes:
        own = rows[name][rows[name]["block"] == number]
        times = np.column_stack((own["scheduled_ns"], own["woken_ns"])).astype(np.int64)
        found.append(Block(name, number, times, cpu_ns, wall_ns, margin_ns))
    return found


def _rows(messages: tuple[bytes, ...]) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    if any(len(message) != _ROWS.itemsize for message in messages):
        raise ValueError("a wake-up is not as long as its definition")
    return np.frombuffer(b"".join(messages), _ROWS)
