"""Recorder: the process that reads the records of a run from the rings and writes the log.

A record is in the file FLUSH_S after the recorder has read it, plus the disk's write time. A recorder with
too little processor time falls behind; records then wait in the rings, which hold RING_SECONDS.
"""

from __future__ import annotations

import select
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from msgspec.json import Decoder

from dxlrun.channels import child_processes
from dxlrun.channels.child_processes import (
    Draining,
    Failed,
    Finish,
    LateMetadata,
    LoopRuns,
    MessageChannel,
    Ready,
)
from dxlrun.channels.ring import Gap, Payload, RecordKind, RingReader
from dxlrun.log.machine import MachineSampler, load_sample
from dxlrun.log.part_writer import PartWriter, open_writer
from dxlrun.log.schemas import MACHINE, LogClosed, RecorderJob
from dxlrun.messages.cdr import Codec
from dxlrun.plan.machine_load import SAMPLE_PERIOD_NS, LoadMeter, MachineLoad

# s; polling interval of empty rings, short against the RING_SECONDS that they hold.
POLL_S = 0.005
# s; about this time of records is lost when the recorder is killed.
FLUSH_S = 0.5
# s; about this time of records is lost when the power fails.
SYNC_S = 2.0
# Records of one ring per turn, so that no ring waits long for another one.
_MOST_PER_TURN = 100


Request = LateMetadata | LoopRuns | Finish
REQUESTS: Decoder[Request] = Decoder(Request)


class Recorder:
    """Moves records from the rings into the log; flushes every 0.5 s, syncs to disk every 2 s."""

    def __init__(self, job: RecorderJob, supervisor: MessageChannel[Request]) -> None:
        self._supervisor = supervisor
        self._log = open_writer(Path(job.path), job.header, job.recording)
        self._rings = [(name, RingReader(descriptor)) for name, descriptor in job.rings.items()]
        self._span = job.span
        self._reported = False
        self._layout = job.header.layout
        self._codec = Codec(MACHINE)
        self._machine: MachineSampler | None = None
        # Load from the start of the loop's process to its first cycle.
        self._start_up: LoadMeter | None = None
        # Load from the first cycle on.
        self._run: LoadMeter | None = None
        self._next_sample_ns = 0
        self._next_flush = self._next_sync = time.monotonic() + FLUSH_S

    def record_until_stopped(self, asked_to_stop: Callable[[], bool]) -> LogClosed:
        """Record until the supervisor or a signal stops it; then empty the rings and finish the log.

        Returns the log's summary and the machine's load.
        """
        self._supervisor.send_message(Ready())
        while True:
            more = self._turn()
            if self._requested_to_finish(0 if more else POLL_S) or asked_to_stop():
                break
        while self._turn():
            self._supervisor.send_message(Draining())
        self._next_sample_ns = 0
        self._sample_machine()
        summary = self._log.close()
        self._report_error()
        loads = (
            MachineLoad() if meter is None else meter.compute_load() for meter in (self._start_up, self._run)
        )
        return LogClosed(summary, *loads)

    def _requested_to_finish(self, seconds: float) -> bool:
        """Handle the supervisor's requests, waiting up to `seconds`; return True if it is time to finish."""
        if not select.select([self._supervisor], [], [], seconds)[0]:
            return False
        finish = False
        for request in self._supervisor.receive_messages():
            if isinstance(request, LateMetadata):
                self._log.late_metadata |= request.records
            elif isinstance(request, LoopRuns):
                self._machine = MachineSampler(request.pid)
                self._start_up = LoadMeter(time.monotonic_ns())
                self._sample_machine()
            else:
                finish = True
        return finish or self._supervisor.closed

    def _turn(self) -> bool:
        """Write some records of each ring, then start a new part, flush, and sample the load when due.

        Returns:
            True when there may be more records.
        """
        full = [self._drain(name, ring) for name, ring in self._rings]
        if isinstance(self._log, PartWriter):
            self._log.split_if_due()
        self._flush_when_due()
        self._sample_machine()
        self._report_error()
        return any(full)

    def _flush_when_due(self) -> None:
        """Write the collected messages to the file FLUSH_S after the end of the last flush; sync when due.

        Counted from its start, a slow disk would leave no time for the rings.
        """
        if time.monotonic() < self._next_flush:
            return
        self._log.finish_chunk()
        if self._span >= 0 and self._log.error is None:
            self._log.span.store(self._span)
        if time.monotonic() >= self._next_sync:
            self._log.sync()
            self._next_sync = time.monotonic() + SYNC_S
        self._next_flush = time.monotonic() + FLUSH_S

    def _sample_machine(self) -> None:
        """Write the machine's load into the log once per sampling period."""
        now_ns = time.monotonic_ns()
        if self._machine is None or now_ns < self._next_sample_ns:
            return
        self._next_sample_ns = now_ns + SAMPLE_PERIOD_NS
        data = self._machine.sample_machine(now_ns)
        if data is not None:
            self._log.machine(now_ns, data)
            sample = load_sample(self._codec.unpack(data))
            for meter in (self._start_up, self._run):
                if meter is not None:
                    meter.add_sample(sample)

    def _drain(self, name: str, ring: RingReader) -> bool:
        """Write up to _MOST_PER_TURN records of one ring into the log; return True if more may be left.

        A due flush does not wait for the remaining records, which may take a recorder without processor time
        seconds.
        """
        lost, record = 0, None
        for _ in range(_MOST_PER_TURN):
            self._flush_when_due()
            record = ring.read_record()
            if record is None:
                break
            if isinstance(record, Gap):
                lost += record.lost
                continue
            if self._run is None and record.kind == RecordKind.CYCLE:
                self._begin_run(record.payload)
            try:
                self._log.write_record(record.kind, record.payload)
            except (ValueError, IndexError, OverflowError):
                # An intact record that does not fit into a log is reported as lost.
                lost += 1
        if lost:
            self._log.gap(name, lost)
        return record is not None

    def _begin_run(self, payload: Payload) -> None:
        """Begin to measure the load of the run at its first cycle; load before that is of the start-up."""
        if len(payload) != self._layout.dtype.itemsize:
            return
        cycle = np.frombuffer(payload, self._layout.dtype)[0]
        if cycle["cycle"] < 0:
            return
        self._run = LoadMeter(int(cycle["scheduled_ns"]))
        if self._start_up is not None:
            self._start_up.end_ns = int(cycle["scheduled_ns"])

    def _report_error(self) -> None:
        if self._log.error is not None and not self._reported:
            self._reported = True
            self._supervisor.send_message(Failed(self._log.error))


def main() -> int:
    """Entry point of the recorder process: `--job-fd N --control-fd M`; returns 1 for an incomplete log."""
    stop: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, frame: stop.append(number))
    job, supervisor = child_processes.begun(RecorderJob, REQUESTS)
    try:
        recorder = Recorder(job, supervisor)
    except OSError as error:
        supervisor.send_message(Failed(f"the log cannot be written: {error.strerror or error} ({job.path})"))
        return 1
    closed = recorder.record_until_stopped(lambda: bool(stop))
    supervisor.send_message(closed)
    return 1 if closed.summary.error or closed.summary.gaps else 0


if __name__ == "__main__":
    sys.exit(main())
