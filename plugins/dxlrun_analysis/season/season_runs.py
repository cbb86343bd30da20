"""Table of the logs below a directory, one row per log with results of its report, cached as Parquet.

A log is read again only if size, inode or a time of its files has changed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, as_completed
from contextlib import suppress
from datetime import UTC, datetime
from hashlib import blake2b
from pathlib import Path
from time import time_ns
from typing import NamedTuple, Protocol, TypeVar

import pyarrow as pa
from pyarrow import parquet

from dxlrun import ROTARY, InputError, Log, LogError, open_log
from dxlrun.tooling.logs import IDENTITY_NAME, is_being_written, is_log_directory, log_files, runtime_hash
from dxlrun_analysis.cycles.punctuality import on_virtual_time
from dxlrun_analysis.finding import ROBOT
from dxlrun_analysis.parts.part import Report
from dxlrun_analysis.parts.servo_parts import EXTREMES
from dxlrun_analysis.report import analyze
from dxlrun_analysis.season.pools import processes

Row = dict[str, object]
Progress = Callable[[str, float], None]
_MEASUREMENT = "latency"  # Metadata record of a log that `dxlrun latency` wrote
_LOG, _LEDGER = ".mcap", ".ledger.jsonl"
_ENDED = "the process reading the log crashed or ran out of memory"
_SETTLED_NS = 2_000_000_000
"""Age from which a file's state counts as final: the coarsest time resolution of file systems (2 s of
FAT). A file that changed more recently can change again without a new time stamp."""
_TEXT, _WHOLE, _NUMBER, _YES = pa.string(), pa.int64(), pa.float64(), pa.bool_()


def _began(report: Report, log: Log) -> datetime | None:
    """Return the wall-clock time of the first deadline, UTC without a time zone; None on virtual time."""
    offset_ns = log.header.epoch_offset_ns
    if not offset_ns:
        return None
    begin_ns = report.totals.periods.begin_ns + offset_ns
    return datetime.fromtimestamp(begin_ns / 1e9, UTC).replace(tzinfo=None)


def _worst(report: Report, field: str) -> str | None:
    worst = next((one for one in report.verdict.findings if one.code != ROBOT), None)
    return getattr(worst, field, None) or None


def _most(values: Iterable[float]) -> float | None:
    return max(values, default=None)


def _latency(report: Report, name: str) -> float | None:
    return None if report.totals.latency is None else getattr(report.totals.latency, name)


def _hottest(report: Report) -> tuple[float | None, str | None]:
    known = [(one.hottest_c, one.joint) for one in EXTREMES.numbers_of(report) if one.hottest_c is not None]
    return max(known, default=(None, None))


def _lowest_voltage(report: Report) -> float | None:
    known = [one.lowest_volts for one in EXTREMES.numbers_of(report) if one.lowest_volts is not None]
    return min(known, default=None)


def _farthest(report: Report) -> tuple[float | None, str | None]:
    turning = [one for one in report.totals.tracking if one.unit is ROTARY and one.worst_rad is not None]
    return max(((one.worst_rad, one.name) for one in turning), default=(None, None))


Value = Callable[[Report, Log], object]
COLUMNS: Mapping[str, tuple[pa.DataType, Value]] = {
    "robot": (_TEXT, lambda report, _: report.robot),
    "began": (pa.timestamp("us"), _began),
    "lasted_s": (_NUMBER, lambda report, _: report.totals.periods.seconds),
    "rate_hz": (_NUMBER, lambda report, _: report.totals.periods.rate_hz),
    "good": (_YES, lambda report, _: report.verdict.good),
    "finding": (_TEXT, lambda report, _: _worst(report, "code")),
    "subject": (_TEXT, lambda report, _: _worst(report, "subject")),
    "sentence": (_TEXT, lambda report, _: _worst(report, "sentence")),
    "findings": (pa.list_(_TEXT), lambda report, _: [one.code for one in report.verdict.findings]),
    "cycles": (_WHOLE, lambda report, _: report.totals.periods.records),
    "skipped": (_WHOLE, lambda report, _: report.totals.periods.skipped),
    "worst_wake_up_us": (_NUMBER, lambda report, _: _latency(report, "max_us")),
    "mean_wake_up_us": (_NUMBER, lambda report, _: _latency(report, "mean_us")),
    "late_share": (_NUMBER, lambda report, _: _latency(report, "share_over_150_us")),
    "asked": (_WHOLE, lambda report, _: sum(servo.asked for servo in report.totals.servos)),
    "lost": (_WHOLE, lambda report, _: sum(servo.lost for servo in report.totals.servos)),
    "errors": (_WHOLE, lambda report, _: sum(servo.errors for servo in report.totals.servos)),
    "noise_bytes": (_WHOLE, lambda report, _: sum(bus.noise_bytes for bus in report.totals.buses)),
    "slowest_reply_us": (_NUMBER, lambda report, _: _most(one.reply_max_us for one in report.totals.servos)),
    "hottest_joint": (_TEXT, lambda report, _: _hottest(report)[1]),
    "hottest_deg_c": (_NUMBER, lambda report, _: _hottest(report)[0]),
    "lowest_voltage_v": (_NUMBER, lambda report, _: _lowest_voltage(report)),
    "worst_joint": (_TEXT, lambda report, _: _farthest(report)[1]),
    "worst_error_rad": (_NUMBER, lambda report, _: _farthest(report)[0]),
    "records_lost": (_WHOLE, lambda report, _: report.totals.gaps),
    "complete": (_YES, lambda report, _: report.about.complete),
    "being_written": (_YES, lambda report, _: report.about.being_written),
    "virtual": (_YES, lambda _, log: on_virtual_time(log)),
    "host": (_TEXT, lambda _, log: log.metadata.get(IDENTITY_NAME, {}).get("host")),
    "kernel": (_TEXT, lambda _, log: log.metadata.get("kernel", {}).get("release")),
    "version": (_TEXT, lambda _, log: log.metadata.get("versions", {}).get("dxlrun")),
}
"""Columns of the table that come from the report on a log: type, and function that returns the value."""
SCHEMA = pa.schema(
    [
        ("log", _TEXT),
        *((name, kind) for name, (kind, _) in COLUMNS.items()),
        ("bytes", _WHOLE),
        ("unreadable", _TEXT),
    ]
)
_KEPT = SCHEMA.append(pa.field("stamp", _TEXT))


class FoundLog(NamedTuple):
    """One log below a directory: a file, or a directory with a log in parts."""

    name: str  # Path relative to the directory
    path: Path  # A file, or the directory of a log in parts
    files: tuple[Path, ...]

    @property
    def stamp(self) -> str:
        """Size, inode and times of its files as text, to recognize a change; empty while they can change
        unnoticed, or a run writes them."""
        try:
            found = [file.stat() for file in self.files]
        except OSError:  # It is deleted or not accessible, which reading reports
            return ""
        if any(time_ns() - one.st_mtime_ns < _SETTLED_NS for one in found) or is_being_written(self.path):
            return ""
        return " ".join(f"{one.st_size}-{one.st_ino}-{one.st_mtime_ns}-{one.st_ctime_ns}" for one in found)


class Folder(NamedTuple):
    """Logs found below a directory, and its other files."""

    directory: Path
    logs: tuple[FoundLog, ...]
    others: tuple[str, ...]  # Other files that do not belong to a log


def find_logs(directory: Path) -> Folder:
    """Find all logs below a directory, in order of their names. Hidden directories are skipped.

    Raises:
        InputError: The directory has no logs.
    """
    logs: list[FoundLog] = []
    others: list[str] = []
    for folder, folders, files in os.walk(directory):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        here = Path(folder)
        parts: tuple[Path, ...] = ()
        if is_log_directory(here):
            parts = log_files(here).files
            logs.append(FoundLog(_name(here, directory), here, parts))
        for name in sorted(files):
            path = here / name
            if path in parts:
                continue
            # Skip pipes, from which a read would not return.
            if name.endswith(_LOG) and (path.is_file() or not path.exists()):
                logs.append(FoundLog(_name(path, directory), path, (path,)))
            elif not name.startswith(".") and not _belongs(name, files):
                others.append(_name(path, directory))
    if not logs:
        raise InputError(f"{directory}: no logs (.mcap) found in this directory or below")
    return Folder(directory, tuple(sorted(logs, key=lambda log: log.name)), tuple(others))


def _name(path: Path, directory: Path) -> str:
    name = directory.resolve().name if path == directory else str(path.relative_to(directory))
    return name.encode(errors="backslashreplace").decode()  # File names are not necessarily UTF-8


def _belongs(name: str, files: Sequence[str]) -> bool:
    return name.endswith(_LEDGER) and name.removesuffix(_LEDGER) + _LOG in files


def row_of(log: FoundLog) -> Row:
    """Analyze a log and return its row; if it cannot be read, the reason is in `unreadable`."""
    row: Row = {"log": log.name, "bytes": sum(file.stat().st_size for file in log.files if file.is_file())}
    try:
        reader = open_log(log.path)
        if _MEASUREMENT in reader.metadata:
            raise LogError("a measurement of `dxlrun latency`, not a run; `dxlrun analyze` shows it")
        report = analyze(reader)
        return row | {name: value(report, reader.about) for name, (_, value) in COLUMNS.items()}
    except LogError as error:
        return row | {"unreadable": str(error).removeprefix(f"{log.path}: ")}
    except Exception as error:  # A failure on this log must not hide the rows of other logs
        reason = str(error).strip().partition("\n")[0]
        return row | {"unreadable": f"internal error: {type(error).__name__}: {reason}"}


def cache_directory() -> Path:
    """Return the directory of the cached tables: `$XDG_CACHE_HOME/dxlrun/logs` (XDG Base Directory
    Specification; ~/.cache by default).

    Raises:
        RuntimeError: The user has no home directory.
    """
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (named if named.is_absolute() else Path.home() / ".cache") / "dxlrun" / "logs"


def table_of(folder: Folder, progress: Progress) -> tuple[pa.Table, int]:
    """Return the table of all logs, and how many were read now; the rest come from the cached table.

    Raises:
        OSError: The table cannot be written to the cache.
    """
    place = os.fsencode(folder.directory.resolve())
    return kept_table(place, folder.logs, lambda missing: _rows(missing, progress))


class StampedLog(Protocol):
    """Log that can have a row in a cached table."""

    @property
    def name(self) -> str:
        """Name of the log in the table."""

    @property
    def stamp(self) -> str:
        """Version of the log's content, to recognize a change; empty if it can change without a new stamp."""


AnyLog = TypeVar("AnyLog", bound=StampedLog)


def kept_table(
    place: bytes, logs: Sequence[AnyLog], read: Callable[[Sequence[AnyLog]], Mapping[str, Row]]
) -> tuple[pa.Table, int]:
    """Return the table of some logs, and the number of rows that were read now.

    A row is read if the cached table does not have it with the same stamp. The cache is then updated.

    Args:
        place: Key of the cached table: path of a directory or URL of a store.
        logs: The logs.
        read: Function that returns the rows of logs by name.

    Raises:
        OSError: The table cannot be written to the cache.
    """
    name = blake2b(place, digest_size=16).hexdigest()
    # Another version of the code can compute other values, so it keeps tables of its own.
    kept_at = cache_directory() / runtime_hash()[:16] / f"{name}.parquet"
    kept_at.parent.mkdir(parents=True, exist_ok=True)
    known: dict[str, Row] = {}
    with suppress(OSError, pa.ArrowException):  # Without a table, or with a damaged one, all logs are read
        known = {row["log"]: row for row in parquet.read_table(kept_at, schema=_KEPT).to_pylist()}
    stamps = {log.name: log.stamp for log in logs}
    missing = [
        log
        for log in logs
        if not (stamp := stamps[log.name]) or known.get(log.name, {}).get("stamp") != stamp
    ]
    known |= read(missing)
    rows = [known[log.name] | {"stamp": stamps[log.name]} for log in logs]
    table = pa.Table.from_pylist(rows, _KEPT)
    if missing:
        # Rename a complete file, so that another process never reads a partial table.
        beside = kept_at.with_suffix(f".{os.getpid()}")
        parquet.write_table(table, beside)
        beside.replace(kept_at)
    return table.drop_columns("stamp"), len(missing)


def _rows(logs: Sequence[FoundLog], progress: Progress) -> dict[str, Row]:
    found = _together(logs, len(os.sched_getaffinity(0)), progress) if logs else {}
    for log in logs:
        # A crashed process breaks the whole pool. Each remaining log is read alone, which identifies the
        # cause.
        if log.name not in found:
            ended: Row = {"log": log.name, "unreadable": _ENDED}
            found |= _together([log], 1, progress) or {log.name: ended}
    return found


def _together(logs: Sequence[FoundLog], count: int, progress: Progress) -> dict[str, Row]:
    """Analyze logs in a pool of `count` processes; return their rows by name. If a process crashes, the
    rows not read by then are missing."""
    found: dict[str, Row] = {}
    with suppress(BrokenExecutor), processes(count) as pool:
        running = [pool.submit(row_of, log) for log in logs]
        for future in as_completed(running):
            row = future.result()
            found[str(row["log"])] = row
            progress(f"{len(found)} of {len(logs)} logs", len(found) / len(logs))
    return found
