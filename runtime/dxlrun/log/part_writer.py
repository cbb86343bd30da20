"""Part writer: writes a log as several files, each a complete log; with `keep`, deletes the oldest."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from msgspec.structs import replace

from dxlrun.channels.ring import Payload, RecordKind
from dxlrun.log.log_file import FOLDER_MODE
from dxlrun.log.log_writer import LogWriter
from dxlrun.log.schemas import CycleSpan, LogHeader, LogSummary
from dxlrun.plan.recording_plan import (
    PART_END_NAME,
    PART_NAME,
    RecordingPlan,
    part_name,
)


def open_writer(path: Path, header: LogHeader, recording: RecordingPlan) -> LogWriter | PartWriter:
    """Open a new log for writing, as one file or a directory of parts, as the plan says. Raises OSError."""
    return PartWriter(path, header, recording) if recording.in_parts else LogWriter(path, header)


class PartWriter:
    """Writer of a log in several files (parts), with the interface of LogWriter.

    `split_if_due` ends a part that is full or old, and deletes expired parts according to the plan; the
    newest part is never deleted.
    """

    def __init__(self, path: Path, header: LogHeader, recording: RecordingPlan) -> None:
        path.mkdir(FOLDER_MODE, parents=True, exist_ok=True)
        self._folder = path
        self._header = header
        self._plan = recording
        self.late_metadata: dict[str, dict[str, str]] = {}
        """Metadata records of the run, written at the end of each part that ends from now on."""
        self.span = CycleSpan()
        """First and last cycle of the whole log, over all parts."""
        self._error: str | None = None
        self._unwritten = 0
        """Number of records that were lost after the log ended early."""
        self._closed: list[LogSummary] = []
        self._kept: deque[tuple[Path, int]] = deque()
        """Finished parts that still exist, each with the time of its newest record, ns."""
        self._summary: LogSummary | None = None
        self._path = path / part_name(0)
        self._log = self._open(0, "start", ())

    @property
    def error(self) -> str | None:
        """Reason why the log ended early, after which nothing is written; None while all is well."""
        return self._error or self._log.error

    def _open(self, index: int, began: str, topics: Iterable[bytes]) -> LogWriter:
        """Open part `index`, repeat the topics' definitions, and note in its metadata why it began."""
        part = {"index": str(index), "began": began, "keep_ns": str(self._plan.keep_ns or "")}
        self._path = self._folder / part_name(index)
        try:
            header = replace(self._header, metadata={**self._header.metadata, PART_NAME: part})
            log = LogWriter(self._path, header, self.span)
        except FileExistsError:
            raise
        except OSError:
            # The file is empty and would look like a part.
            self._path.unlink(missing_ok=True)
            raise
        for topic in topics:
            log.write_record(RecordKind.TAGGED, topic)
        return log

    def _next(self, began: str) -> None:
        """Finish this part and open the next; `began` is the reason. If that fails, the log ends here."""
        if self.error is not None:
            return
        summary = self._close_part(last=False)
        if summary.error is not None:
            self._error = summary.error
            return
        index = len(self._closed) + 1
        ended = self._path
        try:
            log = self._open(index, began, self._log.topics)
        except OSError as error:
            self._error = f"{part_name(index)} cannot be written: {error.strerror or error}"
            return
        self._closed.append(summary)
        self._kept.append((ended, self._log.last_ns))
        self._log = log

    def _close_part(self, *, last: bool) -> LogSummary:
        end = {PART_END_NAME: {"last": "yes" if last else "no"}}
        self._log.late_metadata |= self.late_metadata | end
        return self._log.close()

    def write_record(self, kind: int, payload: Payload) -> None:
        """Write one record from a ring. Raises ValueError for a kind that logs do not have."""
        if self._error is None:
            self._log.write_record(kind, payload)
        else:
            self._unwritten += 1

    def machine(self, t_ns: int, data: bytes) -> None:
        """Write an encoded message about the machine's load to /machine."""
        if self._error is None:
            self._log.machine(t_ns, data)
        else:
            self._unwritten += 1

    def split_if_due(self) -> None:
        """Start a new part if this one is full or old; delete expired parts. Call it after a whole cycle."""
        size, age_ns, keep_ns = self._plan.split_bytes, self._plan.split_ns, self._plan.keep_ns
        now_ns = self._log.last_ns
        if size is not None and self._log.size >= size:
            self._next("size")
        elif age_ns is not None and now_ns - self._log.first_ns >= age_ns:
            self._next("time")
        # A log that has ended must not lose more parts.
        if keep_ns is None or self.error is not None:
            return
        while self._kept and self._kept[0][1] < now_ns - keep_ns:
            # A part that cannot be deleted remains.
            with suppress(OSError):
                self._kept.popleft()[0].unlink()

    def gap(self, source: str, lost: int) -> None:
        """Write an event that `lost` records of `source` did not reach the log."""
        if self._error is None:
            self._log.gap(source, lost)

    def finish_chunk(self) -> None:
        """Write the collected messages, so that a reader finds them even after this process was killed."""
        if self._error is None:
            self._log.finish_chunk()

    def sync(self) -> None:
        """Block until the disk has stored all written chunks."""
        if self._error is None:
            self._log.sync()

    def close(self) -> LogSummary:
        """Finish the last part; return message count, size and error of all parts together."""
        if self._summary is None:
            last = self._close_part(last=True)
            every = [*self._closed, last]
            self._summary = LogSummary(
                messages=sum(one.messages for one in every),
                bytes=sum(one.bytes for one in every),
                gaps=sum(one.gaps for one in every),
                error=self._error or last.error,
                unwritten=self._unwritten + sum(one.unwritten for one in every),
            )
        return self._summary
