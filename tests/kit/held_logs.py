"""Logs that a run is writing, as far as other programs can tell."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def being_written(file: Path) -> Iterator[None]:
    """Hold the lock of the recorder on a file of a log."""
    with file.open("rb") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        yield
