"""A season: the logs below a directory, each converted to tables once, several at a time."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    as_completed,
)
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path

from dxlrun.errors import InputError, ProcessFault
from dxlrun.log.parts import is_log_directory, log_files
from dxlrun_analysis.season.cache import Cache, code_version, stamps
from dxlrun_analysis.season.conversion import Converted, Job, convert

_LOG = ".mcap"
_ENDED = "the process that read it ended: it crashed, or had too little memory"
_LEDGER = ".ledger.jsonl"
Progress = Callable[[str, float], None]
Pool = Callable[[], AbstractContextManager[Executor]]


@dataclass(frozen=True, slots=True)
class FoundLog:
    """One log below the directory of a season."""

    name: str
    """Its path from there."""
    path: Path
    """A file, or the directory of a log in parts."""
    files: tuple[Path, ...]


@dataclass(frozen=True, slots=True)
class Folder:
    """What lies below a directory."""

    directory: Path
    logs: tuple[FoundLog, ...]
    others: tuple[str, ...]
    """Files that are no logs, and do not belong to one."""


@dataclass(frozen=True, slots=True)
class Season:
    """The logs of a directory with their tables."""

    folder: Folder
    tables: dict[str, Path]
    """Names of logs -> directory with their tables."""
    problems: dict[str, str]
    """Names of logs that could not be converted -> why."""
    converted: int
    """How many were converted this time; the others were in the cache."""
    rebuilt: int = 0
    """How many of these were in the cache, and damaged."""


def find_logs(directory: Path) -> Folder:
    """Return the logs below a directory, by name. Raises InputError where there are none."""
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
            if name.endswith(_LOG) and (path.is_file() or not path.exists()):  # a pipe would be read for ever
                logs.append(FoundLog(_name(path, directory), path, (path,)))
            elif not name.startswith(".") and not _belongs(name, files):
                others.append(_name(path, directory))
    if not logs:
        raise InputError(f"{directory}: there are no logs (.mcap) in it or below it")
    return Folder(directory, tuple(sorted(logs, key=lambda log: log.name)), tuple(others))


def _name(path: Path, directory: Path) -> str:
    name = directory.resolve().name if path == directory else str(path.relative_to(directory))
    return name.encode(errors="backslashreplace").decode()  # names of files need not be UTF-8


def _belongs(name: str, files: Sequence[str]) -> bool:
    return name.endswith(_LEDGER) and name.removesuffix(_LEDGER) + _LOG in files


def converted(folder: Folder, cache_directory: Path, pool: Pool, progress: Progress) -> Season:
    """Return a season whose logs all have tables: those that the cache does not have are made in `pool`.

    Raises ProcessFault when a cluster is gone, has other code, or does not share the cache's directory;
    OSError when the cache cannot be written.
    """
    cache = Cache(cache_directory, code_version())
    season = Season(folder, {}, {}, 0)
    missing: list[FoundLog] = []
    for log in folder.logs:
        key = None
        with suppress(OSError):  # it is gone, or may not be looked at: the conversion says so
            key = cache.key(log.path, log.files)
        if key is None:
            missing.append(log)
        else:
            season.tables[log.name] = cache.tables / key
    if not missing:
        return season
    work = _Work(cache, season, missing, progress)
    try:
        work.run(pool)
    finally:
        cache.save()
    return Season(folder, season.tables, season.problems, len(missing), work.rebuilt)


class _Work:
    """The conversion of the logs that the cache does not have."""

    def __init__(self, cache: Cache, season: Season, logs: Sequence[FoundLog], progress: Progress) -> None:
        self._cache, self._season, self._progress = cache, season, progress
        self._waiting = {log.name: log for log in logs}
        self._all = len(logs)
        self.rebuilt = 0
        """Logs whose tables were damaged."""
        self._looked_ns = time.time_ns()
        self._before = {}
        for log in logs:
            with suppress(OSError):
                self._before[log.name] = stamps(log.files)

    def run(self, pool: Pool) -> None:
        """Convert them all; a log that ends its process has that as its problem."""
        with pool() as executor, suppress(BrokenExecutor):
            self._convert(executor, list(self._waiting.values()))
        while self._waiting:  # a process ended, and with it the pool: one log at a time shows which it is
            with pool() as executor:
                self._convert_each(executor)

    def _convert_each(self, executor: Executor) -> None:
        """Convert one log after the other, until one ends its process."""
        for log in list(self._waiting.values()):
            try:
                self._convert(executor, [log])
            except BrokenExecutor:
                del self._waiting[log.name]
                self._season.problems[log.name] = _ENDED
                return

    def _convert(self, executor: Executor, logs: Sequence[FoundLog]) -> None:
        tables = str(self._cache.tables.absolute())
        running: dict[Future[Converted], FoundLog] = {}
        try:
            for log in logs:
                files = tuple(str(file.absolute()) for file in log.files)
                running[executor.submit(convert, Job(str(log.path.absolute()), files, tables))] = log
            for future in as_completed(running):
                self._take(running[future], future)
        except CancelledError:
            raise ProcessFault("the Dask cluster is gone; what was converted before is kept") from None
        finally:
            for future in running:
                future.cancel()

    def _take(self, log: FoundLog, future: Future[Converted]) -> None:
        try:
            result = future.result()
        except (BrokenExecutor, CancelledError):
            raise
        except Exception as error:  # of this log alone: the others are not hidden by it
            result = Converted(problem=_reason(error))
        if result.other_code:
            raise ProcessFault(
                "a worker of the Dask cluster has other code of dxlrun; install the same there"
            )
        del self._waiting[log.name]
        done = self._all - len(self._waiting)
        self._progress(f"{done} of {self._all} logs", done / self._all)
        if result.problem:
            self._season.problems[log.name] = result.problem
            return
        if not self._cache.has(result.key):
            raise ProcessFault(
                f"the tables of {log.name} were written where this machine does not see them: workers need "
                "the same cache directory; XDG_CACHE_HOME names it"
            )
        self.rebuilt += result.rebuilt
        self._season.tables[log.name] = self._cache.tables / result.key
        if log.name in self._before:
            self._cache.remember(log.path, self._before[log.name], result.key, self._looked_ns)


def _reason(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    if isinstance(error, OSError):
        return f"its tables cannot be written: {error.strerror or error}"
    return f"internal error: {type(error).__name__}: {lines[0] if lines else ''}"
