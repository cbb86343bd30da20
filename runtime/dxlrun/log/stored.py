"""Stored logs: finds the logs of runs in a folder, their size and age, and the oldest to delete."""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import msgspec

from dxlrun.errors import LogError
from dxlrun.log.log_file import has_writer
from dxlrun.log.parts import is_log_directory, log_files

MUCH_BYTES = 10 * 10**9
"""Size of a folder of logs, bytes, above which the end of a run reports it to the user."""
_NAME = re.compile(r"\w+_\d{8}_\d{6}(_\d+)?")


class StoredLog(msgspec.Struct, frozen=True):
    """A log of a run in a folder: its path, size in bytes, and time of its last change."""

    path: Path
    bytes: int
    changed_s: float
    """Time of the last write, s since 1970."""

    def delete(self) -> None:
        """Delete the log's files; raises OSError. Other files in the directory of a split log are kept."""
        if not self.path.is_dir():
            self.path.unlink(missing_ok=True)
            return
        for part in log_files(self.path).files:
            part.unlink(missing_ok=True)
        with suppress(OSError):
            self.path.rmdir()


def is_being_written(log: Path) -> bool:
    """Return True if a run is writing this log, given by its file or directory of parts."""
    with suppress(LogError):
        return has_writer(log_files(log).files[-1])
    return False


def stored_logs(folder: Path) -> tuple[StoredLog, ...]:
    """Return the logs in a folder whose names are those of runs, oldest first."""
    found: list[StoredLog] = []
    # A missing or unreadable folder has no logs for this user.
    with suppress(OSError):
        found = [
            one
            for path in folder.iterdir()
            if _NAME.fullmatch(path.name.removesuffix(".mcap"))
            and not path.is_symlink()
            and (one := _stored(path)) is not None
        ]
    return tuple(sorted(found, key=lambda one: (one.changed_s, one.path)))


def bytes_of(log: Path) -> int:
    """Return the size of a log with all parts, bytes; 0 if there is no log at this path."""
    stored = _stored(log)
    return 0 if stored is None else stored.bytes


def oldest_beyond(folder: Path, keep_bytes: int, but: Iterable[Path] = ()) -> tuple[StoredLog, ...]:
    """Return the oldest logs of a folder, whose deletion would leave at most `keep_bytes`.

    Logs in `but` and logs that are being written are not returned.
    """
    logs, spared = stored_logs(folder), set(but)
    left = sum(one.bytes for one in logs)
    found: list[StoredLog] = []
    for one in logs:
        if left <= keep_bytes:
            break
        if one.path not in spared and not is_being_written(one.path):
            found.append(one)
            left -= one.bytes
    return tuple(found)


def _stored(path: Path) -> StoredLog | None:
    """Return path, size and age of the log at a path; None if there is no log."""
    in_parts = is_log_directory(path)
    if not in_parts and (path.suffix != ".mcap" or not path.is_file()):
        return None
    with suppress(OSError, LogError):
        stats = [file.stat() for file in log_files(path).files]
        return StoredLog(path, sum(one.st_size for one in stats), max(one.st_mtime for one in stats))
    return None
