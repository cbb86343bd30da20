"""The recorder: a process that reads the rings and writes the log, at its own pace beside the loop."""

from __future__ import annotations

import os
import select
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from dxlrun.log.header import LogSummary, RecorderJob
from dxlrun.log.log_writer import LogWriter
from dxlrun.run.channels.ring import Gap, RingReader

POLL_S = 0.005
FLUSH_S = 0.5
SYNC_S = 2.0
_MOST_PER_TURN = 2000


@dataclass(frozen=True, slots=True)
class _Wish:
    """What the supervisor asks for in one line."""

    finish: bool = False
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)


class Control:
    """The line to the supervisor: JSON lines both ways; a supervisor that is gone counts as `finish`."""

    __slots__ = ("_descriptor", "_pending", "finish", "metadata")

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._pending = b""
        self.finish = False
        self.metadata: dict[str, dict[str, str]] = {}
        """What the log is to say of the run beside what was known at its start."""

    def say(self, message: dict[str, object]) -> None:
        """Send one line; nobody listening is not the recorder's trouble."""
        try:
            os.write(self._descriptor, msgspec.json.encode(message) + b"\n")
        except OSError:
            self.finish = True

    def wait(self, seconds: float) -> None:
        """Wait for a line, at most so long; set `finish` when it says so, or at the end of the line."""
        if not select.select([self._descriptor], [], [], seconds)[0]:
            return
        try:
            data = os.read(self._descriptor, 4096)
        except OSError:
            data = b""
        self._pending += data
        *lines, self._pending = self._pending.split(b"\n")
        for line in lines:
            try:
                wish = msgspec.json.decode(line, type=_Wish)
            except msgspec.MsgspecError:
                continue  # a line that is no JSON asks for nothing
            self.finish |= wish.finish
            self.metadata |= wish.metadata
        self.finish |= not data


class Recorder:
    """Drains rings into a log, flushing every 0.5 s and syncing every 2 s of the machine's time."""

    def __init__(self, job: RecorderJob, control: Control) -> None:
        self._control = control
        self._log = LogWriter(Path(job.path), job.header)
        self._rings = [(name, RingReader(descriptor)) for name, descriptor in job.rings.items()]
        self._reported = False
        self._next_flush = self._next_sync = time.monotonic() + FLUSH_S

    def run(self, asked_to_stop: Callable[[], bool]) -> LogSummary:
        """Record until the supervisor or a signal ends it; then drain every ring and finish the file."""
        self._control.say({"ready": True})
        while not (self._control.finish or asked_to_stop()):
            if not self._turn():
                self._control.wait(POLL_S)
            else:
                self._control.wait(0)
        while self._turn():
            self._control.say({"draining": True})
        self._log.late_metadata |= self._control.metadata
        summary = self._log.close()
        self._report()
        return summary

    def _turn(self) -> bool:
        """Take what is there, bounded, and keep the file's rhythm; True when there may be more."""
        full = [self._drain(name, ring) for name, ring in self._rings]
        now = time.monotonic()
        if now >= self._next_flush:
            sync = now >= self._next_sync
            self._log.flush(sync=sync)
            self._next_flush = now + FLUSH_S
            self._next_sync = now + SYNC_S if sync else self._next_sync
        self._report()
        return any(full)

    def _drain(self, name: str, ring: RingReader) -> bool:
        """Write what is in a ring, at most _MOST_PER_TURN records; return whether there may be more."""
        lost, record = 0, None
        for _ in range(_MOST_PER_TURN):
            record = ring.read()
            if record is None:
                break
            if isinstance(record, Gap):
                lost += record.lost
                continue
            try:
                self._log.take(record.kind, record.payload)
            except (ValueError, IndexError, OverflowError):
                lost += 1  # whole, but not what the log can hold: declared like any other loss
        if lost:
            self._log.gap(name, lost)
        return record is not None

    def _report(self) -> None:
        if self._log.error is not None and not self._reported:
            self._reported = True
            self._control.say({"error": self._log.error})


def main(job_fd: int, control_fd: int) -> int:
    """Run a recorder on these descriptors; return the exit code: 1 when the log is not whole."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # only the supervisor takes Ctrl-C
    stop: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, frame: stop.append(number))
    control = Control(control_fd)
    with os.fdopen(job_fd, "rb") as stream:
        job = msgspec.json.decode(stream.read(), type=RecorderJob)
    try:
        recorder = Recorder(job, control)
    except OSError as error:
        control.say({"error": f"the log cannot be written: {error.strerror or error} ({job.path})"})
        return 1
    summary = recorder.run(lambda: bool(stop))
    control.say({"summary": msgspec.to_builtins(summary)})
    return 1 if summary.error or summary.gaps else 0
