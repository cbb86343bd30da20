"""Parts: a log in several files, each a whole log; with a trigger, only what lies around faults.

Which records are kept is decided here, how they are written by LogWriter. Without split and trigger a log is
one file, and nothing of this runs.
"""

from __future__ import annotations

import struct
import sys
from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from msgspec import structs

from dxlrun.channels.events import Severity, decode_event
from dxlrun.channels.messages import decode_message, decode_topic
from dxlrun.channels.ring import Payload, RecordKind
from dxlrun.channels.snapshots import INTERVAL_NS, TOPIC
from dxlrun.log.log_writer import LogWriter
from dxlrun.log.schemas import FAILURES_NAME, LogHeader, LogSummary
from dxlrun.messages.cdr import Codec
from dxlrun.plan.recording_plan import (
    HELD_RECORD,
    MOST_HELD,
    PART_END_NAME,
    PART_NAME,
    Began,
    LeftOut,
    PartBegin,
    PartEnd,
    RecordingPlan,
    part_name,
)

FOLDER_MODE = 0o750
"""Of a directory of parts: as the logs in it."""
_TIME = struct.Struct("<q")
_MACHINE = -1
"""Kind of a message about the machine, which comes from no ring."""
MOST_BACK_NS = 2 * INTERVAL_NS
"""How much longer than `before` records are held for the sake of a start; rounds may come late."""
_KEPT = frozenset((RecordKind.EVENT, RecordKind.TAKEN_COMMAND, RecordKind.TOPIC, _MACHINE))
"""Records that are in the log whether there is a fault or not: they are few."""


def open_writer(path: Path, header: LogHeader, recording: RecordingPlan) -> LogWriter | PartWriter:
    """Open a log: a file, or a directory of parts. Raises OSError when it cannot be begun."""
    return PartWriter(path, header, recording) if recording.in_parts else LogWriter(path, header)


@dataclass(frozen=True, slots=True)
class HeldRecord:
    """One record that is not written yet."""

    kind: int
    payload: bytes
    t_ns: int | None
    """Of a cycle: when it woke."""


class HeldRecords:
    """The newest records, oldest first; each cycle ends a group, which leaves as one.

    They reach back to the newest start that is older than the length, so that what is kept can be replayed.
    """

    def __init__(self, length_ns: int) -> None:
        self._length_ns = length_ns
        self._records: deque[HeldRecord] = deque()
        self._first = 0
        """Number of the oldest of them, counted from the first that was ever held."""
        self._cycles: deque[tuple[int, int]] = deque()
        """Time and number of each cycle among them."""
        self._starts: deque[tuple[int, int]] = deque()
        """Time and number of each start."""
        self._bytes = 0

    def start(self, t_ns: int) -> None:
        """Note that a replay can go on with the next record: it begins a round of snapshots at the end of the
        cycle that woke then, or nothing between it and what is written was left out.
        """
        self._starts.append((t_ns, self._first + len(self._records)))

    def add(self, kind: int, payload: bytes, t_ns: int | None) -> None:
        """Hold a record; `t_ns`: of a cycle."""
        if t_ns is not None:
            self._cycles.append((t_ns, self._first + len(self._records)))
        self._records.append(HeldRecord(kind, payload, t_ns))
        self._bytes += len(payload) + HELD_RECORD

    def old(self, now_ns: int) -> list[HeldRecord]:
        """Take out what is older than asked for, or more than the memory for it."""
        out: list[HeldRecord] = []
        until = self._until(now_ns - self._length_ns)
        while self._bytes > MOST_HELD or (
            self._cycles and all(mine < its for mine, its in zip(self._cycles[0], until, strict=True))
        ):
            self._take_group(out)
        while self._starts and self._starts[0][1] < self._first:
            self._starts.popleft()
        return out

    def _until(self, t_ns: int) -> tuple[int, int]:
        """Return time and number of the oldest record to hold, where the length ends at `t_ns`."""
        starts = self._starts
        while len(starts) > 1 and starts[1][0] <= t_ns:
            starts.popleft()
        if starts and starts[0][0] < t_ns - MOST_BACK_NS:
            starts.popleft()
        return starts[0] if starts and starts[0][0] <= t_ns else (t_ns, sys.maxsize)

    def _take_group(self, out: list[HeldRecord]) -> None:
        while self._records:
            record = self._records.popleft()
            self._first += 1
            self._bytes -= len(record.payload) + HELD_RECORD
            out.append(record)
            if record.t_ns is not None:
                self._cycles.popleft()
                return

    def all(self) -> list[HeldRecord]:
        """Take out everything."""
        out = [*self._records]
        self._first += len(out)
        self._records.clear()
        self._starts.clear()
        self._cycles.clear()
        self._bytes = 0
        return out


class PartWriter:
    """Writes a log in parts, as LogWriter writes one file; `settle` ends a part that is full or old.

    With a trigger, records are written until `after` behind the first cycle. From then on they are held back;
    what is older than `before` and the snapshots in front of it, or more than MOST_HELD bytes, is left out,
    but for events and commands, which are written then. An event of severity error writes what is held, and
    what comes until `after` behind the last such event: in a part of its own if anything was left out before
    it.
    """

    def __init__(self, path: Path, header: LogHeader, recording: RecordingPlan) -> None:
        path.mkdir(FOLDER_MODE, parents=True, exist_ok=True)
        self._folder = path
        self._header = header
        self._plan = recording
        self.late_metadata: dict[str, dict[str, str]] = {}
        """Of the run: written at the end of each part that ends from now on."""
        self._error: str | None = None
        self._unwritten = 0
        """Records that came when the last part that could be written was closed."""
        self._closed: list[LogSummary] = []
        self._summary: LogSummary | None = None
        self._topics: dict[bytes, None] = {}
        """Announced topics, which each part announces again."""
        self._snapshots: dict[int, Codec] = {}
        """By the number of their topic."""
        self._dtype = header.layout.dtype
        self._held = HeldRecords(recording.before_ns)
        self._now_ns = 0
        self._until_ns: int | None = None
        """Behind this time records are held back; None: never."""
        self._writing = True
        self._left_out = LeftOut()
        self._left_out_before = 0
        """Cycles before this part."""
        self._faults = 0
        self._index = 0
        self._began_ns: int | None = None
        """Time of the part's first record."""
        self._log = self._open(PartBegin(0, "start"))

    @property
    def error(self) -> str | None:
        """Why the log is not whole; nothing is written any more."""
        return self._error or self._log.error

    def _open(self, begin: PartBegin) -> LogWriter:
        path = self._folder / part_name(begin.index)
        metadata = {**self._header.metadata, PART_NAME: begin.to_metadata()}
        try:
            log = LogWriter(path, replace(self._header, metadata=metadata))
        except FileExistsError:
            raise
        except OSError:
            path.unlink(missing_ok=True)  # it has nothing, and would look like a part
            raise
        for topic in self._topics:
            log.take(RecordKind.TOPIC, topic)
        return log

    def _next(self, began: Began, fault: str = "", before_ns: int = 0) -> None:
        """End the part and begin another; when that cannot be, the log ends with this part."""
        if self.error is not None:
            return
        left_out, self._left_out = self._left_out, LeftOut()
        self._left_out_before += left_out.cycles
        begin = PartBegin(self._index + 1, began, fault, before_ns, left_out)
        self._log.late_metadata |= self.late_metadata
        self._log.late_metadata[PART_END_NAME] = PartEnd(last=False, faults=self._faults).to_metadata()
        summary = self._log.close()
        if summary.error is not None:
            self._error = summary.error
            return
        try:
            log = self._open(begin)
        except OSError as error:
            name = part_name(begin.index)
            self._error = f"{name} cannot be written: {error.strerror or error}"
            return
        self._closed.append(summary)
        self._log, self._index, self._began_ns = log, begin.index, None

    def take(self, kind: int, payload: Payload) -> None:
        """Write or hold one record of a ring. Raises ValueError when it is none that the log can hold."""
        t_ns, fault = self._look(kind, payload)
        self._keep(kind, payload, t_ns)
        if fault is not None and self._plan.trigger is not None:
            self._fault(fault)

    def machine(self, t_ns: int, data: bytes) -> None:
        """Write or hold a message about the machine."""
        self._keep(_MACHINE, _TIME.pack(t_ns) + data, None)

    def _keep(self, kind: int, payload: Payload, t_ns: int | None) -> None:
        if self._writing:
            self._write(kind, payload)
        else:
            self._held.add(kind, bytes(payload), t_ns)
            self._leave_out(self._held.old(self._now_ns))

    def _look(self, kind: int, payload: Payload) -> tuple[int | None, str | None]:
        """Follow time and topics; return the time of a cycle, or the sentence of a fault."""
        if kind == RecordKind.CYCLE:
            cycle = np.frombuffer(payload, self._dtype, 1)[0]
            t_ns, number = int(cycle["woken_ns"]), int(cycle["cycle"])
            self._now_ns = max(self._now_ns, t_ns)
            if self._plan.trigger is not None and self._until_ns is None and number >= 0:
                self._until_ns = t_ns + self._plan.after_ns
            return t_ns, None
        if kind == RecordKind.EVENT:
            event = decode_event(payload)
            self._now_ns = max(self._now_ns, event.t_ns)
            return None, f"{event.source}: {event.text}" if event.severity >= Severity.ERROR else None
        if kind == RecordKind.TOPIC:
            self._topics[bytes(payload)] = None
            number, topic = decode_topic(payload)
            if topic.name == TOPIC:
                self._snapshots[number] = Codec(topic.type)
        if kind == RecordKind.MESSAGE and not self._writing:
            self._look_for_round(payload)
        return None, None

    def _look_for_round(self, payload: Payload) -> None:
        """Note where snapshots begin, with that of the loop."""
        message = decode_message(payload)
        codec = self._snapshots.get(message.topic)
        if codec is not None:
            values = codec.unpack(message.data)
            if not values["controller"] and values["piece"] == 0:
                self._held.start(message.t_ns)

    def _write(self, kind: int, payload: Payload) -> None:
        if self._error is not None:
            self._unwritten += 1
            return
        if self._began_ns is None and self._now_ns:
            self._began_ns = self._now_ns
        if kind == _MACHINE:
            (t_ns,) = _TIME.unpack_from(payload)
            self._log.machine(t_ns, bytes(payload[_TIME.size :]))
        else:
            self._log.take(kind, payload)

    def _leave_out(self, records: list[HeldRecord]) -> None:
        """Write what is always kept of records that were held, and count the others."""
        for record in records:
            if record.kind in _KEPT:
                self._write(record.kind, record.payload)
            elif record.kind == RecordKind.CYCLE:
                number = int(np.frombuffer(record.payload, self._dtype, 1)[0]["cycle"])
                one = self._left_out
                first = one.first if one.cycles else number
                self._left_out = structs.replace(one, cycles=one.cycles + 1, first=first, last=number)
            elif record.kind == RecordKind.PACKETS:
                self._left_out = structs.replace(self._left_out, batches=self._left_out.batches + 1)
            else:
                self._left_out = structs.replace(self._left_out, messages=self._left_out.messages + 1)

    def _fault(self, sentence: str) -> None:
        """Write what is held, and all until `after` from now."""
        self._faults += 1
        if self._until_ns is None:  # in the set-up, which is kept in any case
            return
        self._until_ns = self._now_ns + self._plan.after_ns
        if self._writing:
            return
        self._writing = True
        held = self._held.all()
        if self._left_out != LeftOut():
            times = [record.t_ns for record in held if record.t_ns is not None]
            self._next("fault", sentence[:200], max(0, self._now_ns - times[0]) if times else 0)
        for record in held:
            self._write(record.kind, record.payload)

    def fail(self, sentence: str) -> None:
        """Keep what is held because of something that no ring reports."""
        if self._plan.trigger is not None:
            self._fault(sentence)

    def settle(self) -> None:
        """End the part if it is full or old, or what is kept of a fault; call it behind a whole cycle."""
        if self._writing and self._until_ns is not None and self._now_ns > self._until_ns:
            self._writing = False
            self._held.start(self._now_ns)
        if not self._writing:  # only what is kept in any case comes
            return
        size, age_ns = self._plan.split_bytes, self._plan.split_ns
        if size is not None and self._log.size >= size:
            self._next("size")
        elif age_ns is not None and self._began_ns is not None and self._now_ns - self._began_ns >= age_ns:
            self._next("time")

    def gap(self, source: str, lost: int) -> None:
        """Declare that `lost` records of `source` did not reach the log; it becomes an event."""
        if self._error is None:
            self._log.gap(source, lost)

    def flush(self, *, sync: bool = False) -> None:
        """Finish the chunk in progress, so that a reader finds it; with `sync`, wait for the disk."""
        if self._error is None:
            self._log.flush(sync=sync)

    def close(self) -> LogSummary:
        """Finish the last part, and return what is in all of them; a second call returns the same."""
        if self._summary is not None:
            return self._summary
        if failures := self.late_metadata.get(FAILURES_NAME):
            self.fail(next(iter(failures.values())))
        self._leave_out(self._held.all())
        self._log.late_metadata |= self.late_metadata
        end = PartEnd(last=True, faults=self._faults, left_out=self._left_out)
        self._log.late_metadata[PART_END_NAME] = end.to_metadata()
        last = self._log.close()
        every = [*self._closed, last]
        self._summary = LogSummary(
            messages=sum(one.messages for one in every),
            bytes=sum(one.bytes for one in every),
            gaps=sum(one.gaps for one in every),
            error=self._error or last.error,
            unwritten=self._unwritten + sum(one.unwritten for one in every),
            faults=None if self._plan.trigger is None else self._faults,
            left_out=self._left_out_before + self._left_out.cycles,
        )
        return self._summary
