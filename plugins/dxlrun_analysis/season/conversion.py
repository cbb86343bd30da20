"""Conversion of one log to the tables of a season; runs in processes of its own, on any machine.

A log that cannot be read has a row too, with the sentence that says why.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow as pa

from dxlrun.channels.cycle import Floats
from dxlrun.errors import LogError
from dxlrun.log.identity import HOST, IDENTITY_NAME
from dxlrun.log.reader import Log, open_log
from dxlrun_analysis.cycles.latency import on_virtual_time
from dxlrun_analysis.export.parquet import ParquetDirectory
from dxlrun_analysis.export.tables import EVENTS, LogTables, Rows, cycle_times
from dxlrun_analysis.finding import ROBOT
from dxlrun_analysis.joints.tracking import missing_states
from dxlrun_analysis.report import Report, analyze
from dxlrun_analysis.season.cache import code_version, content_key, seal, stamps, whole

Row = dict[str, object]
_MEASUREMENT = "latency"
"""The metadata record of a log that `dxlrun latency` wrote."""

_TEXT, _WHOLE, _NUMBER, _YES = pa.string(), pa.int64(), pa.float64(), pa.bool_()
SCHEMAS: Mapping[str, pa.Schema] = {
    "logs": pa.schema(
        {
            "robot": _TEXT,
            "began": pa.timestamp("us"),
            "lasted_s": _NUMBER,
            "rate_hz": _NUMBER,
            "good": _YES,
            "finding": _TEXT,
            "subject": _TEXT,
            "sentence": _TEXT,
            "cycles": _WHOLE,
            "skipped": _WHOLE,
            "worst_wake_up_us": _NUMBER,
            "mean_wake_up_us": _NUMBER,
            "late_share": _NUMBER,
            "asked": _WHOLE,
            "lost": _WHOLE,
            "errors": _WHOLE,
            "noise_bytes": _WHOLE,
            "slowest_reply_us": _NUMBER,
            "hottest_joint": _TEXT,
            "hottest_deg_c": _NUMBER,
            "lowest_voltage_v": _NUMBER,
            "worst_joint": _TEXT,
            "worst_error_rad": _NUMBER,
            "records_lost": _WHOLE,
            "complete": _YES,
            "virtual": _YES,
            "host": _TEXT,
            "kernel": _TEXT,
            "version": _TEXT,
            "bytes": _WHOLE,
            "unreadable": _TEXT,
        }
    ),
    "servos": pa.schema(
        {
            "bus": _TEXT,
            "servo_id": _WHOLE,
            "joint": _TEXT,
            "asked": _WHOLE,
            "lost": _WHOLE,
            "replies": _WHOLE,
            "errors": _WHOLE,
            "error_names": _TEXT,
            "reply_median_us": _NUMBER,
            "reply_max_us": _NUMBER,
        }
    ),
    "joints": pa.schema(
        {
            "joint": _TEXT,
            "invalid": _WHOLE,
            "oldest_ms": _NUMBER,
            "clamped": _WHOLE,
            "rms_rad": _NUMBER,
            "worst_rad": _NUMBER,
            "lag_ms": _NUMBER,
            "settling_ms": _NUMBER,
            "rest_rad": _NUMBER,
            "hottest_deg_c": _NUMBER,
            "lowest_voltage_v": _NUMBER,
        }
    ),
    "findings": pa.schema(
        {"place": _WHOLE, "finding": _TEXT, "subject": _TEXT, "sentence": _TEXT, "remedy": _TEXT}
    ),
    "events": pa.schema(
        {
            "time_s": _NUMBER,
            "t_ns": _WHOLE,
            "name": _TEXT,
            "severity": _TEXT,
            "source": _TEXT,
            "text": _TEXT,
            "data": _TEXT,
        }
    ),
    "cycles": pa.schema(
        {
            "cycle": _WHOLE,
            "time_s": _NUMBER,
            "t_ns": _WHOLE,
            "late_us": _NUMBER,
            "read_us": _NUMBER,
            "update_us": _NUMBER,
            "write_us": _NUMBER,
            "period_ms": _NUMBER,
            "skipped": _WHOLE,
            "commands": _WHOLE,
            "invalid": _WHOLE,
        }
    ),
}
"""The tables of a season by name, with their columns; `log` comes before them."""


@dataclass(frozen=True, slots=True)
class Job:
    """A log to convert, as it goes to a worker."""

    log: str
    files: tuple[str, ...]
    """Its parts; a log in one file is its only one."""
    tables: str
    """Directory of the tables; by its name, the code that makes them."""


@dataclass(frozen=True, slots=True)
class Converted:
    """A log whose tables are there, or why they are not."""

    key: str = ""
    problem: str = ""
    """Nothing was written: the files cannot be opened here, or the worker has other code."""
    other_code: bool = False
    rebuilt: bool = False
    """Its tables were there, and damaged."""


def convert(job: Job) -> Converted:
    """Write the tables of a log, unless one of the same content has them. Raises OSError for a full disk."""
    directory = Path(job.tables)
    if directory.name != code_version():
        return Converted(problem="other code of dxlrun", other_code=True)
    files = [Path(file) for file in job.files]
    try:
        before = stamps(files)
        key = content_key(files)
    except OSError as error:
        return Converted(problem=f"cannot be read: {error.strerror or error}")
    if whole(directory / key):
        return Converted(key)
    rebuilt = _removed(directory / key)
    directory.mkdir(parents=True, exist_ok=True)
    beside = directory / f".{key}.{os.getpid()}"
    try:
        _write(Path(job.log), sum(stamp[0] for stamp in before), beside)
        if stamps(files) != before:  # the tables may have more than what was hashed: the log is being written
            key = f"{key}-{os.getpid()}"
        seal(beside)
        with suppress(OSError):  # another process was quicker with the same content
            beside.rename(directory / key)
        return Converted(key, rebuilt=rebuilt)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def _removed(tables: Path) -> bool:
    """Remove what is in the place of a log's tables; return whether there was something."""
    there = os.path.lexists(tables)
    if there and (tables.is_symlink() or not tables.is_dir()):
        tables.unlink()
    shutil.rmtree(tables, ignore_errors=True)
    return there


def _write(log: Path, size: int, directory: Path) -> None:
    """Write all tables of a log; of one that cannot be read a row with the sentence, and empty tables."""
    try:
        with ParquetDirectory(directory, SCHEMAS) as files:
            seen = _Seen(files)
            reader = open_log(log)
            if _MEASUREMENT in reader.metadata:
                raise LogError("a measurement of `dxlrun latency`, not a run; `dxlrun analyze` shows it")
            report = analyze(reader, seen.take)
            files.write(_rows(report, reader.about, seen, size))
    except LogError as error:
        reason = str(error).removeprefix(f"{log}: ")
        shutil.rmtree(directory)
        with ParquetDirectory(directory, SCHEMAS) as files:
            files.write([_of("logs", [{"bytes": size, "unreadable": reason}])])


class _Seen:
    """What is taken from the slices themselves: cycles, events, the extremes of temperature and voltage."""

    def __init__(self, files: ParquetDirectory) -> None:
        self._files = files
        self._tables = LogTables(only=frozenset((EVENTS,)))
        self.hottest: Floats | None = None
        """deg C, one element a joint, NaN where it was never read."""
        self.lowest: Floats | None = None
        """V"""

    @property
    def begin_ns(self) -> int:
        """When the log begins, ns of the run's clock."""
        return self._tables.begin_ns

    def take(self, log: Log) -> None:
        """Write the cycles and events of a slice. Raises LogError."""
        for rows in self._tables.take(log):
            self._files.write([Rows("events", rows.table.select(SCHEMAS["events"].names))])
        cycles = log.cycles
        if not len(cycles):
            return
        columns = cycle_times(cycles, self.begin_ns)
        invalid = pa.array(np.count_nonzero(missing_states(cycles), axis=1))
        self._files.write([Rows("cycles", pa.table({**columns, "invalid": invalid}))])
        hottest = np.fmax.reduce(cycles["temperature"], axis=0)
        lowest = np.fmin.reduce(cycles["voltage"], axis=0)
        self.hottest = hottest if self.hottest is None else np.fmax(self.hottest, hottest)
        self.lowest = lowest if self.lowest is None else np.fmin(self.lowest, lowest)


def _rows(report: Report, about: Log, seen: _Seen, size: int) -> Iterator[Rows]:
    yield _of("logs", [_log(report, about, seen, size)])
    yield _of("joints", _joints(report, about, seen))
    yield _of(
        "servos",
        (
            {**_fields("servos", servo), "error_names": ", ".join(servo.error_names)}
            for servo in report.servos
        ),
    )
    findings = enumerate(report.verdict.findings, 1)
    yield _of(
        "findings",
        ({**_fields("findings", one), "place": place, "finding": one.code} for place, one in findings),
    )


def _log(report: Report, about: Log, seen: _Seen, size: int) -> Row:
    periods, late = report.periods, report.latency
    worst = next((one for one in report.verdict.findings if one.code != ROBOT), None)
    hot = max(_known(seen.hottest, about), default=None)
    turning = [joint for joint in report.joints if joint.unit == "rad"]
    far = max(((j.worst_rad, j.name) for j in turning if j.worst_rad is not None), default=None)
    identity, kernel = about.metadata.get(IDENTITY_NAME, {}), about.metadata.get("kernel", {})
    return {
        "robot": report.robot,
        "began": _began(about, seen.begin_ns),
        "lasted_s": periods.seconds,
        "rate_hz": periods.rate_hz,
        "good": report.verdict.good,
        "finding": worst and worst.code,
        "subject": (worst and worst.subject) or None,
        "sentence": worst and worst.sentence,
        "cycles": periods.records,
        "skipped": periods.skipped,
        "worst_wake_up_us": late and late.max_us,
        "mean_wake_up_us": late and late.mean_us,
        "late_share": late and late.share_over_150_us,
        "asked": sum(servo.asked for servo in report.servos),
        "lost": sum(servo.lost for servo in report.servos),
        "errors": sum(servo.errors for servo in report.servos),
        "noise_bytes": sum(bus.noise_bytes for bus in report.buses),
        "slowest_reply_us": max((servo.reply_max_us for servo in report.servos), default=None),
        "hottest_joint": hot and hot[1],
        "hottest_deg_c": hot and hot[0],
        "lowest_voltage_v": min((volts for volts, _ in _known(seen.lowest, about)), default=None),
        "worst_joint": far and far[1],
        "worst_error_rad": far and far[0],
        "records_lost": report.gaps,
        "complete": report.complete,
        "virtual": on_virtual_time(about),
        "host": identity.get(HOST),
        "kernel": kernel.get("release"),
        "version": about.metadata.get("versions", {}).get("dxlrun"),
        "bytes": size,
    }


def _joints(report: Report, about: Log, seen: _Seen) -> Iterator[Row]:
    hottest = {joint: value for value, joint in _known(seen.hottest, about)}
    lowest = {joint: value for value, joint in _known(seen.lowest, about)}
    for joint in report.joints:
        extremes = {"hottest_deg_c": hottest.get(joint.name), "lowest_voltage_v": lowest.get(joint.name)}
        yield {**_fields("joints", joint), "joint": joint.name, **extremes}


def _known(values: Floats | None, about: Log) -> Iterator[tuple[float, str]]:
    """Yield the values that are known, each with its joint."""
    for value, joint in zip(() if values is None else values.tolist(), about.joints, strict=False):
        if math.isfinite(value):
            yield value, joint


def _began(about: Log, begin_ns: int) -> datetime | None:
    """Return the wall time at which a log begins, in UTC without a mark; None on virtual time."""
    if not about.header.epoch_offset_ns:
        return None
    return datetime.fromtimestamp((begin_ns + about.header.epoch_offset_ns) / 1e9, UTC).replace(tzinfo=None)


def _fields(table: str, row: object) -> Row:
    """Return the fields of a result that are columns of a table."""
    return {name: getattr(row, name) for name in SCHEMAS[table].names if hasattr(row, name)}


def _of(table: str, rows: Iterable[Row]) -> Rows:
    return Rows(table, pa.Table.from_pylist(list(rows), SCHEMAS[table]))
