"""Log walk: reads the files of a log one after the other as a single log, also while it grows."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from dxlrun.errors import LogError
from dxlrun.log.log_file import has_writer
from dxlrun.log.parts import log_files, missing_parts
from dxlrun.log.reading.chunks import MAGIC, McapFile, Messages
from dxlrun.log.schemas import METADATA_NAME
from dxlrun.plan.recording_plan import PART_END_NAME, PART_NAME

_BUFFER = 1 << 18
"""Size of the read buffer, bytes: most records after a chunk are skipped without a system call."""


class _OtherRunError(Exception):
    """Raised when a part in a directory belongs to another run than the first part."""


@dataclass(slots=True)
class LogWalk:
    """Reads all files of a log one by one; a further read continues where the last one ended."""

    path: Path
    file: McapFile = field(default_factory=McapFile)
    """Metadata, channels and damage of all files together; `finished` refers to the last file."""
    first_part: int = 0
    """Number of the first part that still exists, from its metadata."""
    share: float = 0.0
    """Share of the files that was read, 0 to 1."""
    _file: Path | None = None
    """File in which the next read continues; a path and not an index, because older parts may be deleted."""
    _part: int = 0
    """Number of files before `_file` that were read."""

    def survey(self) -> None:
        """Read metadata, attachments and channels, but no messages. Raises LogError as `messages`."""
        for _ in self.messages(chunks=False):
            pass

    def messages(self, *, chunks: bool = True) -> Iterator[Messages]:
        """Yield the messages of all files chunk by chunk; `chunks=False` yields none, but reads the metadata.

        Raises LogError without a readable MCAP file, or for an empty one.
        """
        log, found = log_files(self.path), self.file
        found.damage += log.damage
        found.on_metadata = self._take_metadata
        refused: LogError | None = None
        files = [file for file in log.files if self._file is None or _order(file) >= _order(self._file)]
        for number, file in enumerate(files):
            if self._file not in (None, file):
                if number and not found.finished and refused is None:
                    found.damage.append(self.no_end)
                self._part += 1
                found.begin_file(self._part)
            self._file, found.name = file, "" if file == self.path else file.name
            try:
                with _opened(file) as (stream, size):
                    for messages in found.walk(stream, size, chunks=chunks):
                        self.share = (number + stream.tell() / size) / len(files)
                        yield messages
                refused = None
            except _OtherRunError:
                found.damage.append(f"{file.name} belongs to another run and was skipped")
                found.finished = True
            except LogError as error:
                if len(log.files) == 1:
                    raise
                refused = error
                found.damage.append(str(error).removeprefix(f"{self.path}/"))
        if METADATA_NAME not in found.metadata and refused is not None:
            raise refused
        last = found.metadata.get(PART_END_NAME, {}).get("last")
        if found.name and found.finished and last == "no":
            found.damage.append(f"the parts after {found.name} are missing")

    @property
    def is_being_written(self) -> bool:
        """True if a run is still writing the file in which reading ended."""
        return not self.file.finished and self._file is not None and has_writer(self._file)

    @property
    def no_end(self) -> str:
        """Sentence that the last file read has no end, with the reason."""
        name = self.file.name or "the file"
        if self.is_being_written:
            return f"{name} is still being written by a run"
        return f"{name} ends early: the recorder was killed or could not write"

    def _take_metadata(self, name: str, record: dict[str, str]) -> None:
        if name == METADATA_NAME and self.file.metadata.get(name) not in (None, record):
            raise _OtherRunError
        if name == PART_NAME and self._part == 0:
            with suppress(KeyError, ValueError):
                self.first_part = int(record["index"])
            if self.file.name and self.first_part and not record.get("keep_ns"):
                self.file.damage.append(missing_parts(0, self.first_part))


def _order(part: Path) -> tuple[int, str]:
    """Return a key by which parts are sorted; their numbers have four or more digits."""
    return len(part.name), part.name


@contextmanager
def _opened(path: Path) -> Iterator[tuple[IO[bytes], int]]:
    """Open an MCAP file; yield stream and size. Raises LogError if it is missing, empty or not MCAP."""
    try:
        with path.open("rb", buffering=_BUFFER) as stream:
            size = os.fstat(stream.fileno()).st_size
            if size == 0:
                raise LogError(f"{path}: the file is empty: the recorder wrote nothing")
            start = stream.read(len(MAGIC))
            if not start.startswith(MAGIC):
                # Imported here because a log needs no forms.
                from dxlrun.description.other_files import foreign_sentence

                if foreign := foreign_sentence(path):
                    raise LogError(f"{path}: {'; '.join(foreign)}")
                raise LogError(f"{path}: this is not an MCAP file; give a log of dxlrun")
            yield stream, size
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from error
