"""Logs that a run is writing, or did not finish, as far as other programs can tell."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

FOOTER_BYTES = 37  # mcap.dev/spec: a record of 20 bytes, and the magic at the end of the file


def cut_end(file: Path) -> None:
    """Leave a file of a log as a recorder that was killed leaves it."""
    os.truncate(file, file.stat().st_size - FOOTER_BYTES)


@contextmanager
def being_written(file: Path) -> Iterator[None]:
    """Hold the lock of the recorder on a file of a log."""
    with file.open("rb") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        yield
