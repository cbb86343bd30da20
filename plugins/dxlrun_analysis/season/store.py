"""Logs in an object store, reached by fsspec: `s3://BUCKET/PREFIX`, or `file:///DIRECTORY` for a mounted one.

Next to each log is its row of the table of logs, as JSON. The row is written last, so a log with a row is
complete. The table of a store consists of these rows; the logs themselves are not read.
"""

from __future__ import annotations

import atexit
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from tempfile import mkdtemp
from typing import NamedTuple

import fsspec
import msgspec
import pyarrow as pa
from pyarrow import json

from dxlrun import DxlrunError, InputError
from dxlrun.tooling.logs import is_being_written
from dxlrun.tooling.verbs import missing_extra
from dxlrun_analysis.season.season_runs import SCHEMA, Folder, FoundLog, Progress, Row, kept_table, table_of

_ROW, _LOG = ".run.json", ".mcap"
UNFINISHED = "incomplete upload; continue with `dxlrun upload` on its robot"
DAMAGED = f"damaged row in the store (NAME{_ROW}); rewrite the row with `dxlrun upload` on its robot"
_AT_ONCE = 500
"""Number of rows that are requested from the store together."""
_OPTIONS: Mapping[str, Mapping[str, object]] = {
    "s3": {
        "skip_instance_cache": True,
        "use_listings_cache": False,
        "max_concurrency": 1,  # parts of a large log in memory, 50 MB each
        "config_kwargs": {"connect_timeout": 5, "read_timeout": 20, "retries": {"max_attempts": 3}},
    },
    "file": {"auto_mkdir": True},
}


class StoreEntry(NamedTuple):
    """One log in an object store; without a row if its upload has not ended."""

    name: str
    row: str  # Path of its row; empty if the row does not exist yet
    stamp: str


class Store(NamedTuple):
    """An object store below a prefix: its logs, and the names of other files."""

    directory: str  # URL
    files: fsspec.AbstractFileSystem
    root: str
    logs: tuple[StoreEntry, ...]
    others: tuple[str, ...]

    def load_table(self, progress: Progress) -> tuple[pa.Table, int]:
        """Return the table of all logs, and how many rows were fetched now; the rest come from the cache.

        Raises:
            OSError: The table cannot be written to the cache.
        """
        return kept_table(self.directory.encode(), self.logs, lambda missing: self._rows(missing, progress))

    def _rows(self, logs: Sequence[StoreEntry], progress: Progress) -> dict[str, Row]:
        rows: dict[str, Row] = {log.name: {"log": log.name, "unreadable": UNFINISHED} for log in logs}
        there = [log for log in logs if log.row]
        for first in range(0, len(there), _AT_ONCE):
            some = there[first : first + _AT_ONCE]
            with _reached(self.directory):
                found = self.files.cat([log.row for log in some])
            rows |= {log.name: _row(log.name, found[log.row]) for log in some}
            progress(f"{first + len(some)} of {len(there)} logs", (first + len(some)) / len(there))
        return rows


def find_store(url: str) -> Store:
    """List the logs below the URL of an object store.

    Raises:
        InputError: The URL is wrong.
        DxlrunError: The store cannot be reached.
    """
    files, root = _opened(url)
    with _reached(url):
        found = files.find(root, detail=True)
    names = {path.removeprefix(root).lstrip("/"): (path, about) for path, about in found.items()}
    logs = {
        name.removesuffix(_ROW): StoreEntry(name.removesuffix(_ROW), path, _stamp(about))
        for name, (path, about) in names.items()
        if name.endswith(_ROW)
    }
    others = []
    for name in names:
        folder = os.path.dirname(name)
        if name.endswith(_LOG) and name not in logs and folder not in logs:
            logs[name] = StoreEntry(name, "", "")
        elif not name.endswith((_ROW, _LOG)):
            others.append(name)
    return Store(url, files, root, tuple(logs[name] for name in sorted(logs)), tuple(sorted(others)))


def fetch(url: str) -> Path:
    """Download one log from a store; return the path of the copy, which is deleted at exit."""
    files, root = _opened(url)
    copy = Path(mkdtemp(prefix="dxlrun-")) / root.rpartition("/")[2]
    atexit.register(shutil.rmtree, copy.parent, ignore_errors=True)
    with _reached(url):
        files.get(root, str(copy), recursive=files.isdir(root))
    return copy


class Upload(NamedTuple):
    """Result of an upload: names of the logs that were copied, and of those that were not."""

    uploaded: tuple[str, ...]
    there: tuple[str, ...]  # Already complete in the store
    written: tuple[str, ...]  # Being written by a run
    others: tuple[str, ...]  # The store has another run with the same name


def upload(folder: Folder, url: str, progress: Progress) -> Upload:
    """Copy the logs of finished runs to a store, each with its row, unless they are complete there.

    Raises:
        DxlrunError: The store cannot be reached. The next call continues after the last complete log.
    """
    store = find_store(url)
    ended = folder._replace(logs=tuple(log for log in folder.logs if not is_being_written(log.path)))
    known = {row["log"]: row for row in store.load_table(progress)[0].to_pylist()}
    rows = table_of(ended, progress)[0].to_pylist() if ended.logs else []
    uploaded, there, others = [], [], []
    written = [log.name for log in folder.logs if log not in ended.logs]
    for done, (log, row) in enumerate(zip(ended.logs, rows, strict=True)):
        progress(log.name, done / len(rows))
        before = known.get(log.name, {"unreadable": UNFINISHED})
        if before["unreadable"] not in (UNFINISHED, DAMAGED):
            # Logs of several robots can have the same name; these columns identify the run.
            same = all(before[each] == row[each] for each in ("robot", "began", "host"))
            if not same or (row["began"] is None and before["bytes"] != row["bytes"]):
                others.append(log.name)
                continue
            if before["bytes"] >= row["bytes"]:
                there.append(log.name)
                continue
        with _reached(url):
            size = sum(_put(store, file, log) for file in log.files)
            # The log changed during the upload, so a run is writing it.
            if size != row["bytes"]:
                written.append(log.name)
                continue
            store.files.pipe_file(f"{store.root}/{log.name}{_ROW}", msgspec.json.encode(row))
        uploaded.append(log.name)
    return Upload(tuple(uploaded), tuple(there), tuple(written), tuple(others))


def _put(store: Store, file: Path, log: FoundLog) -> int:
    """Copy one file of a log to the store; return its size there, bytes."""
    to = f"{store.root}/{log.name}" + ("" if file == log.path else f"/{file.name}")
    store.files.put_file(str(file), to)
    return int(store.files.info(to)["size"])


def _row(name: str, data: bytes) -> Row:
    options = json.ParseOptions(explicit_schema=SCHEMA, unexpected_field_behavior="ignore")
    try:
        (row,) = json.read_json(BytesIO(data), parse_options=options).to_pylist()
    except (pa.ArrowException, ValueError):
        return {"log": name, "unreadable": DAMAGED}
    return {**row, "log": name}


def _stamp(about: Mapping[str, object]) -> str:
    return f"{about['size']} {about.get('ETag') or about.get('mtime')}"


def _opened(url: str) -> tuple[fsspec.AbstractFileSystem, str]:
    """Return the file system of a store's URL, and the path in it."""
    protocol, _, path = url.partition("://")
    if protocol not in _OPTIONS:
        raise InputError(f"{url}: unknown kind of store; write s3://BUCKET/PREFIX or file:///DIRECTORY")
    if protocol == "s3" and (missing := missing_extra("a store of S3", "store", "s3fs")):
        raise InputError(missing)
    if not path.strip("/"):
        raise InputError(f"{url}: bucket or directory is missing; write s3://BUCKET/PREFIX")
    files, root = fsspec.core.url_to_fs(url, **_OPTIONS[protocol])
    return files, root.rstrip("/")


@contextmanager
def _reached(url: str) -> Iterator[None]:
    """Convert any exception to a DxlrunError with the URL; store libraries have no common base class."""
    try:
        yield
    except Exception as error:
        reason = str(error).strip().partition("\n")[0] or type(error).__name__
        raise DxlrunError(f"{url}: {reason}") from error
