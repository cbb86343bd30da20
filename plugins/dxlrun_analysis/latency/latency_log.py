"""Log of a latency measurement: an MCAP file as those of runs, with a topic of wake-ups for each condition.

`dxlrun analyze` computes the same tables from it; other tools plot the topics `/latency/CONDITION`.
"""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from dxlrun import LogError, LogReader
from dxlrun.tooling.logs import LogSummary, TopicWriter
from dxlrun.tooling.topics import messages
from dxlrun_analysis.latency.conditions import Settings
from dxlrun_analysis.latency.statistics import Block, Result, Times, figures

ROBOT = "latency"  # Takes the place of the robot's name in logs of runs
METADATA_NAME = "latency"  # Metadata record that marks the log of a measurement
_TOPIC = "/latency/"
_AT_ONCE = 10_000
"""Number of wake-ups that are converted to Python integers at a time; ten million take over 1 GB."""


@dataclass(slots=True)
class WakeUp:
    """Message of one wake-up: deadline and actual time, ns of the monotonic clock, and its block."""

    scheduled_ns: int
    woken_ns: int
    block: Annotated[int, messages.Number("int32")]


class MeasurementDetails(msgspec.Struct, frozen=True):
    """Metadata in the log of a measurement: settings, load, remarks, and processor time of each block."""

    settings: Settings
    load: str
    remarks: tuple[str, ...]
    processes: tuple[tuple[str, int, int, int, int], ...]
    """One row per block: condition, number, processor time, elapsed time, polled time; ns."""


def write_log(
    path: Path, settings: Settings, blocks: Sequence[Block], load: str, remarks: Sequence[str]
) -> LogSummary:
    """Write the log of a latency measurement into a new or empty file.

    Raises:
        OSError: The file cannot be opened.
    """
    processes = tuple((one.condition, one.number, one.cpu_ns, one.wall_ns, one.margin_ns) for one in blocks)
    about = MeasurementDetails(settings, load, tuple(remarks), processes)
    metadata = {METADATA_NAME: {"about": msgspec.json.encode(about).decode()}}
    log = TopicWriter(path, ROBOT, settings.period_ns, metadata)
    topics = {one.name: log.open_topic(f"{_TOPIC}{one.name}", WakeUp) for one in settings.conditions}
    for block in blocks:
        topic = topics[block.condition]
        for begin in range(0, len(block.times), _AT_ONCE):
            for scheduled_ns, woken_ns in block.times[begin : begin + _AT_ONCE].tolist():
                log.append(topic, woken_ns, (scheduled_ns, woken_ns, block.number))
    return log.close()


def machine() -> str:
    """Return a description of this machine's kernel and architecture for a report."""
    here = platform.uname()
    return f"{here.system} {here.release}, {here.version}, {here.machine}"


def machine_of(log: LogReader) -> str:
    """Return a description of the kernel and architecture of the machine on which a log was made."""
    kernel = log.metadata.get("kernel", {})
    system = f"{kernel.get('system', '')} {kernel.get('release', '')}".strip()
    return ", ".join(filter(None, (system, kernel.get("version"), kernel.get("machine"))))


def is_measurement(log: LogReader) -> bool:
    """Return whether a log was made by `dxlrun latency`."""
    return METADATA_NAME in log.metadata


def measurement(log: LogReader) -> tuple[tuple[Block, ...], Result]:
    """Return the blocks of wake-ups in the log of a measurement, and their statistics.

    Raises:
        LogError: The log is damaged.
    """
    try:
        about = msgspec.json.decode(log.metadata[METADATA_NAME]["about"], type=MeasurementDetails)
    except (KeyError, msgspec.MsgspecError) as error:
        raise LogError(f"{log.path}: the details of the measurement cannot be read: {error}") from error
    rows = {one.name: _rows(log, f"{_TOPIC}{one.name}") for one in about.settings.conditions}
    blocks = tuple(
        Block(name, number, rows[name][0][rows[name][1] == number], cpu_ns, wall_ns, margin_ns)
        for name, number, cpu_ns, wall_ns, margin_ns in about.processes
        if name in rows
    )
    result = figures(about.settings, blocks, about.load, (*about.remarks, *log.damage))
    if not result.conditions:
        raise LogError("; ".join((f"{log.path}: the log has no wake-up", *log.damage)))
    return blocks, result


def _rows(log: LogReader, topic: str) -> tuple[Times, NDArray[np.int64]]:
    """Return deadline and actual time of each wake-up of a condition, shape (wake-ups, 2), and its block."""
    if topic not in log.topics:  # A topic exists from its first message on, which a full disk can prevent
        return np.zeros((0, 2), np.int64), np.zeros(0, np.int64)
    found = log.columns(topic, "scheduled_ns", "woken_ns", "block")
    times = np.column_stack((found["scheduled_ns"], found["woken_ns"])).astype(np.int64)
    return times, found["block"].astype(np.int64)
