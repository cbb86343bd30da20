"""The cache of a season: the tables of each log, converted once, found by the content of its files.

The key of a log is the BLAKE2b hash of all its bytes. Hashing reads them, which is cheap beside the
conversion, but not every time: the key is remembered with size, inode and times of each file, as git's index
does, and a file that is as it was is not opened again. One that changed less than two seconds before it was
looked at may change once more within one tick of its file system, so its key is not remembered.

Tables depend on the code that makes them too: each version of it has a directory of its own, and those of
others are removed when they were not used for a month.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from hashlib import blake2b
from pathlib import Path

import msgspec

from dxlrun.log.identity import RUNTIME, code_hashes

_SETTLED_NS = 2_000_000_000
"""Coarsest ticks of file systems: 2 s of FAT, 1 s of some network file systems."""
_UNUSED_S = 30 * 86400.0
_PIECE = 1 << 20
_INDEX = "files.json"
_USED = "used"
_SUMS = "sums.json"

Stamp = tuple[int, int, int, int]
"""Size, inode, and times of the last changes of content and of anything, ns."""


class Remembered(msgspec.Struct, frozen=True):
    """The key of a log whose files were like this."""

    stamps: tuple[Stamp, ...]
    key: str


def default_directory() -> Path:
    """Return `$XDG_CACHE_HOME/dxlrun/logs` (XDG Base Directory Specification; ~/.cache by default).

    Raises RuntimeError without a home directory.
    """
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (named if named.is_absolute() else Path.home() / ".cache") / "dxlrun" / "logs"


@cache
def code_version() -> str:
    """Return what the tables are made by: a hash of dxlrun's own code."""
    return code_hashes()[RUNTIME][:16]


class Cache:
    """The directory with the tables of logs, and the keys that are remembered."""

    def __init__(self, directory: Path, code: str) -> None:
        """Open the cache. Raises OSError."""
        self.tables = directory / code
        self.tables.mkdir(parents=True, exist_ok=True)
        (self.tables / _USED).touch()
        self._index = directory / _INDEX
        self._keys = _read(self._index)
        self._changed = False
        _remove_unused(directory)

    def key(self, log: Path, files: Sequence[Path]) -> str | None:
        """Return the key of a log whose files have not changed since it was remembered."""
        known = self._keys.get(_place(log))
        if known is None or not self.has(known.key):
            return None
        return known.key if stamps(files) == known.stamps else None

    def has(self, key: str) -> bool:
        """Return whether the tables of a log are there, as they were written."""
        return whole(self.tables / key)

    def remember(self, log: Path, before: tuple[Stamp, ...], key: str, looked_ns: int) -> None:
        """Remember the key of a log whose files were like this `looked_ns`, ns since 1970, and still are."""
        if all(looked_ns - max(stamp[2:]) > _SETTLED_NS for stamp in before):
            self._keys[_place(log)] = Remembered(before, key)
            self._changed = True

    def save(self) -> None:
        """Write the remembered keys, for the next time. Raises OSError."""
        if not self._changed:
            return
        known = {**_read(self._index), **self._keys}  # another process may have written meanwhile
        beside = self._index.with_suffix(f".{os.getpid()}")
        beside.write_bytes(msgspec.json.encode(known))
        beside.replace(self._index)


def seal(tables: Path) -> None:
    """Write the hashes of all files of a directory into it. Raises OSError."""
    sums = {file.name: content_key([file]) for file in tables.iterdir()}
    (tables / _SUMS).write_bytes(msgspec.json.encode(sums))


def whole(tables: Path) -> bool:
    """Return whether a directory was sealed, and has all its files as they were then."""
    try:
        sums = msgspec.json.decode((tables / _SUMS).read_bytes(), type=dict[str, str])
        return bool(sums) and all(content_key([tables / name]) == found for name, found in sums.items())
    except (OSError, msgspec.MsgspecError, ValueError):
        return False


def stamps(files: Sequence[Path]) -> tuple[Stamp, ...]:
    """Return how files are now. Raises OSError."""
    found = [file.stat() for file in files]
    return tuple((one.st_size, one.st_ino, one.st_mtime_ns, one.st_ctime_ns) for one in found)


def content_key(files: Sequence[Path]) -> str:
    """Return the hash of the bytes of files, one behind the other with their lengths. Raises OSError."""
    found = blake2b(digest_size=20)
    for file in files:
        size = 0
        with file.open("rb") as stream:
            while piece := stream.read(_PIECE):
                found.update(piece)
                size += len(piece)
        found.update(size.to_bytes(8, "little"))
    return found.hexdigest()


def _place(log: Path) -> str:
    return str(log.resolve()).encode(errors="backslashreplace").decode()  # names of files need not be UTF-8


def _read(index: Path) -> dict[str, Remembered]:
    try:
        return msgspec.json.decode(index.read_bytes(), type=dict[str, Remembered])
    except (OSError, msgspec.MsgspecError):
        return {}


def _remove_unused(directory: Path) -> None:
    for tables in directory.iterdir():
        with suppress(OSError):  # another process may remove it too
            if tables.is_dir() and time.time() - (tables / _USED).stat().st_mtime > _UNUSED_S:
                shutil.rmtree(tables)
