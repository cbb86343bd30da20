"""Parts: finds the files of a log in a directory, sorts them, and reports missing ones."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import msgspec

from dxlrun.errors import LogError
from dxlrun.plan.recording_plan import part_name

_PART = re.compile(r"part_(\d{4,9})\.mcap")


class LogFiles(msgspec.Struct, frozen=True):
    """Files of one log, and what is missing between them."""

    files: tuple[Path, ...]
    """Existing files, oldest first; a log that was not split has one."""
    damage: tuple[str, ...] = ()
    """A sentence for each gap in the numbers of the parts."""


def log_files(path: Path) -> LogFiles:
    """Return the files of a log: the file itself, or the parts in a directory.

    Raises LogError for a directory without parts or one that cannot be read, and for a pipe or a device, on
    which a read could block forever.
    """
    if not path.is_dir():
        if path.exists() and not path.is_file():
            raise LogError(f"{path}: this is a pipe or a device; give a file")
        return LogFiles((path,))
    try:
        found = {
            int(match[1]): each
            for each in path.iterdir()
            if (match := _PART.fullmatch(each.name)) and each.is_file()
        }
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from error
    if not found:
        raise LogError(f"{path}: the directory has no log ({part_name(0)} not found)")
    numbers = sorted(found)
    missing = [missing_parts(before + 1, after) for before, after in pairwise(numbers) if after > before + 1]
    return LogFiles(tuple(found[number] for number in numbers), tuple(missing))


def is_log_directory(path: Path) -> bool:
    """Return True if a directory contains at least one part of a log."""
    try:
        return path.is_dir() and any(_PART.fullmatch(each.name) and each.is_file() for each in path.iterdir())
    except OSError:
        return False


def missing_parts(first: int, end: int) -> str:
    """Return the sentence that the parts numbered `first` to `end` - 1 are missing."""
    if end == first + 1:
        return f"{part_name(first)} is missing"
    return f"{part_name(first)} to {part_name(end - 1)} are missing"
