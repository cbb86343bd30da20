"""Stored logs: which are being written, how much disk the logs of runs take, and which are the oldest."""

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
"""From here on the end of a run says how much its folder has."""
_NAME = re.compile(r"\w+_\d{8}_\d{6}(_\d+)?")


class StoredLog(msgspec.Struct, frozen=True):
    """A log that a run has left in a folder."""

    path: Path
    bytes: int
    changed_s: float
    """When it was written last, s since 1970."""

    def delete(self) -> None:
        """Delete the log; raises OSError. Other files in the directory of a log in parts stay."""
        if not self.path.is_dir():
            self.path.unlink(missing_ok=True)
            return
        for part in log_files(self.path).files:
            part.unlink(missing_ok=True)
        with suppress(OSError):
            self.path.rmdir()


def is_being_written(log: Path) -> bool:
    """Return whether a run is writing a log, a file or a directory of parts; False where there is none."""
    with suppress(LogError):
        return has_writer(log_files(log).files[-1])
    return False


def stored_logs(folder: Path) -> tuple[StoredLog, ...]:
    """Return the logs in a folder whose names runs have given, the oldest first."""
    found: list[StoredLog] = []
    with suppress(OSError):  # gone, or not to be read: it has none for this user
        found = [
            one
            for path in folder.iterdir()
            if _NAME.fullmatch(path.name.removesuffix(".mcap"))
            and not path.is_symlink()
            and (one := _stored(path)) is not None
        ]
    return tuple(sorted(found, key=lambda one: (one.changed_s, one.path)))


def bytes_of(log: Path) -> int:
    """Return the size of a log, 0 where there is none."""
    stored = _stored(log)
    return 0 if stored is None else stored.bytes


def oldest_beyond(folder: Path, keep_bytes: int, but: Iterable[Path] = ()) -> tuple[StoredLog, ...]:
    """Return the oldest logs without which the others fit into `keep_bytes`.

    `but` and logs that are being written are not among them.
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
    """Return what lies at a path; None: no log."""
    in_parts = is_log_directory(path)
    if not in_parts and (path.suffix != ".mcap" or not path.is_file()):
        return None
    with suppress(OSError, LogError):
        stats = [file.stat() for file in log_files(path).files]
        return StoredLog(path, sum(one.st_size for one in stats), max(one.st_mtime for one in stats))
    return None
