"""The recorder's process: what the rings carry is in the log, whatever happens to it."""

from __future__ import annotations

import json
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.kit.awaited import DEADLINE_S

from dxlrun.channels import ring
from dxlrun.channels.child_processes import LateMetadata, LoopRuns, MessageChannel
from dxlrun.channels.cycle import CycleLayout
from dxlrun.channels.event_records import LONGEST_EVENT, EventBody, EventCode, EventRing, Severity
from dxlrun.channels.logged_packets import LONGEST_BATCH, PacketBatch
from dxlrun.channels.ring import RecordKind, RingWriter, record_size
from dxlrun.log.log_reader import read_log
from dxlrun.log.recorder import _MOST_PER_TURN, REQUESTS, Recorder
from dxlrun.log.schemas import CycleSpan, LogHeader, LogTopic, RecorderJob
from dxlwire.clock import VirtualClock
from dxlwire.packets import PacketKind

Cycle = Callable[[int], bytes]


@dataclass
class Recording:
    """A recorder at work, and the writers' ends of its rings."""

    path: Path
    process: subprocess.Popen[bytes]
    span: int
    control: socket.socket
    cycles: RingWriter
    packets: PacketBatch
    events: EventRing
    lines: Iterator[dict[str, Any]] = field(init=False)

    def __post_init__(self) -> None:
        self.lines = (json.loads(line) for line in self.control.makefile("rb"))

    def finish(self) -> dict[str, Any]:
        self.control.sendall(b'{"type": "Finish"}\n')
        return self.summary()

    def summary(self) -> dict[str, Any]:
        summary: dict[str, Any] = next(line["summary"] for line in self.lines if "summary" in line)
        return summary


Start = Callable[..., Recording]


def clock_module(clock: VirtualClock) -> SimpleNamespace:
    """Stand in for the module `time`."""
    return SimpleNamespace(monotonic=lambda: clock.now_ns() / 1e9, monotonic_ns=clock.now_ns)


@pytest.fixture
def start(tmp_path: Path, header: LogHeader, layout: CycleLayout) -> Iterator[Start]:
    descriptors: list[int] = []
    started: list[Recording] = []

    def make(
        path: Path | None = None, cycles_kept: int = 64, before: Callable[[RingWriter], None] | None = None
    ) -> Recording:
        path = path or tmp_path / "run.mcap"
        rings = {
            "loop/cycles": ring.create("cycles", cycles_kept * record_size(layout.size), layout.size),
            "loop/packets": ring.create("packets", 4 * LONGEST_BATCH, LONGEST_BATCH),
            "loop/events": ring.create("events", 2 * LONGEST_EVENT, LONGEST_EVENT),
        }
        job_fd = os.memfd_create("job")
        ours, theirs = socket.socketpair()
        ours.settimeout(60)
        span = os.memfd_create("span")
        os.write(job_fd, msgspec.json.encode(RecorderJob(str(path), header, rings, span=span)))
        os.lseek(job_fd, 0, os.SEEK_SET)
        descriptors.extend([*rings.values(), job_fd, span])
        cycles = RingWriter(rings["loop/cycles"])
        if before is not None:
            before(cycles)
        words = ["--job-fd", str(job_fd), "--control-fd", str(theirs.fileno())]
        process = subprocess.Popen(
            [sys.executable, "-m", "dxlrun.log.recorder", *words],
            pass_fds=[*rings.values(), job_fd, span, theirs.fileno()],
        )
        theirs.close()
        recording = Recording(
            path,
            process,
            span,
            ours,
            cycles,
            PacketBatch(RingWriter(rings["loop/packets"])),
            EventRing(RingWriter(rings["loop/events"]), VirtualClock(5)),
        )
        started.append(recording)
        return recording

    yield make
    for recording in started:
        recording.process.kill()
        recording.process.wait()
        recording.control.close()
    for descriptor in descriptors:
        os.close(descriptor)


def test_what_the_loop_gets_of_the_machine_is_in_the_log(start: Start, cycle: Cycle) -> None:
    recording = start()
    recording.cycles.append(RecordKind.CYCLE, cycle(0))
    recording.control.sendall(b'{"type": "LoopRuns", "pid": %d}\n' % os.getpid())
    recording.finish()
    sample: Any
    (sample,) = read_log(recording.path).messages(LogTopic.MACHINE)
    assert sample["loop_voluntary"] >= 0
    assert len(sample["idle"]) >= 1


def test_what_the_rings_carry_is_in_the_log_byte_for_byte(start: Start, cycle: Cycle) -> None:
    recording = start()
    assert next(recording.lines) == {"type": "Ready"}
    sent = [bytes([255, 255, number]) for number in range(30)]
    for number in range(30):
        recording.cycles.append(RecordKind.CYCLE, cycle(number))
        recording.packets.packet(0, PacketKind.STATUS, 1, number, number + 1, sent[number])
        recording.packets.commit_packets()
    recording.events.emit_event("loop", EventBody(EventCode.TORQUE_OFF, Severity.INFO, "every servo is limp"))
    summary = recording.finish()
    assert recording.process.wait(DEADLINE_S) == 0
    log = read_log(recording.path)
    assert log.cycles.tobytes() == b"".join(cycle(number) for number in range(30))
    assert [packet.data for packet in log.packets] == sent
    assert [event.text for event in log.events] == ["every servo is limp"]
    assert log.complete
    assert summary["gaps"] == 0
    assert summary["bytes"] == recording.path.stat().st_size


def test_records_from_before_it_was_ready_are_recorded(start: Start, cycle: Cycle) -> None:
    recording = start(before=lambda cycles: cycles.append(RecordKind.CYCLE, cycle(0)))
    recording.finish()
    assert len(read_log(recording.path).cycles) == 1


def test_a_record_that_never_becomes_whole_is_declared_at_the_end(start: Start, cycle: Cycle) -> None:
    def torn(cycles: RingWriter) -> None:
        cycles.append(RecordKind.CYCLE, cycle(0))
        at = cycles.head
        cycles.append(RecordKind.CYCLE, cycle(1))
        cycles._bytes[64 + at + 40] ^= 1

    summary = start(before=torn).finish()
    assert summary["gaps"] == 1


def test_what_was_overwritten_is_declared_and_counted(start: Start, cycle: Cycle) -> None:
    def storm(cycles: RingWriter) -> None:
        for number in range(100):
            cycles.append(RecordKind.CYCLE, cycle(number))

    recording = start(cycles_kept=10, before=storm)
    summary = recording.finish()
    log = read_log(recording.path)
    assert summary["gaps"] + len(log.cycles) == 100
    assert summary["gaps"] == 90
    (event,) = log.events
    assert event.code == EventCode.RECORDER_GAP
    assert "90 records of loop/cycles" in event.text
    assert recording.process.wait(DEADLINE_S) == 1


def test_recorder_measures_the_machine_from_the_loop_s_begin_to_its_end(
    tmp_path: Path, header: LogHeader, layout: CycleLayout, cycle: Cycle
) -> None:
    memory = ring.create("cycles", 100 * record_size(layout.size), layout.size)
    writer = RingWriter(memory)
    ours, theirs = socket.socketpair()
    turns: list[int] = []

    def asked_to_stop() -> bool:
        """Let the loop begin with cycles that are due long ago, and end after two samples."""
        turns.append(len(turns))
        if len(turns) == 2:
            writer.append(RecordKind.CYCLE, cycle(0))
        time.sleep(0.15)
        return len(turns) == 5

    with ours, theirs:
        MessageChannel(ours, REQUESTS).send_message(LoopRuns(os.getpid()))
        job = RecorderJob(str(tmp_path / "run.mcap"), header, {"loop/cycles": memory})
        closed = Recorder(job, MessageChannel(theirs, REQUESTS)).record_until_stopped(asked_to_stop)
    os.close(memory)
    assert LogTopic.MACHINE in read_log(tmp_path / "run.mcap").topics
    # the sample at the end covers half a second or more; the first cycle was due before it began
    assert closed.run_load.seconds > 0.4
    assert closed.start_up_load.seconds == 0


@pytest.mark.parametrize("overwritten", [0, 7])
def test_what_waits_at_the_end_is_drained_however_much_it_is(
    tmp_path: Path, header: LogHeader, layout: CycleLayout, cycle: Cycle, overwritten: int
) -> None:
    """A recorder that was stopped while it was behind: two turns and a half are in the ring."""
    count = 2 * _MOST_PER_TURN + 1000
    memory = ring.create("cycles", count * record_size(layout.size), layout.size)
    writer, record = RingWriter(memory), cycle(0)
    for _ in range(count + overwritten):
        writer.append(RecordKind.CYCLE, record)
    ours, theirs = socket.socketpair()
    with ours, theirs:
        control = MessageChannel(theirs, REQUESTS)
        MessageChannel(ours, REQUESTS).send_message(LateMetadata({"grants": {"loop": "none"}}))
        job = RecorderJob(str(tmp_path / "run.mcap"), header, {"loop/cycles": memory})
        summary = Recorder(job, control).record_until_stopped(lambda: True).summary
    os.close(memory)
    log = read_log(tmp_path / "run.mcap")
    assert len(log.cycles) + summary.gaps == count + overwritten
    assert bool(summary.gaps) is bool(overwritten)
    assert [event.code for event in log.events] == [EventCode.RECORDER_GAP] * bool(overwritten)
    assert log.metadata["grants"] == {"loop": "none"}


def test_a_record_of_another_robot_is_declared_not_written(start: Start, cycle: Cycle) -> None:
    recording = start()
    recording.cycles.append(RecordKind.CYCLE, b"short")
    recording.cycles.append(RecordKind.CYCLE, cycle(1))
    assert recording.finish()["gaps"] == 1
    assert read_log(recording.path).cycles["cycle"] == [1]


def test_after_a_kill_the_log_is_readable_up_to_the_last_flush(start: Start, cycle: Cycle) -> None:
    recording = start()
    assert next(recording.lines) == {"type": "Ready"}
    for number in range(20):
        recording.cycles.append(RecordKind.CYCLE, cycle(number))
    while CycleSpan.load(recording.span).last_ns is None:  # until a flush, which needs no help from here
        assert recording.process.poll() is None
    assert read_log(recording.path).being_written
    recording.process.send_signal(signal.SIGKILL)
    recording.process.wait()
    log = read_log(recording.path)
    assert not log.complete
    assert not log.being_written
    last = CycleSpan(int(log.cycles["scheduled_ns"][0]), int(log.cycles["written_ns"][-1])).last_cycle_text
    assert log.damage == (f"the file ends early: the recorder was killed or could not write; {last}",)
    assert CycleSpan.load(recording.span).last_cycle_text == last
    assert log.cycles.tobytes() == b"".join(cycle(number) for number in range(20))


def test_a_recorder_that_is_short_of_processor_time_flushes_every_half_second(
    tmp_path: Path, header: LogHeader, layout: CycleLayout, cycle: Cycle, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each record takes 5 ms, a hundred times as long as usual, and 3000 wait in three rings."""
    clock = VirtualClock(0)
    monkeypatch.setattr("dxlrun.log.recorder.time", clock_module(clock))
    rings = {name: ring.create(name, 1000 * record_size(layout.size), layout.size) for name in "abc"}
    for memory in rings.values():
        writer = RingWriter(memory)
        for number in range(1000):
            writer.append(RecordKind.CYCLE, cycle(number))
    flushed: list[int] = []
    ours, theirs = socket.socketpair()
    with ours, theirs:
        job = RecorderJob(str(tmp_path / "run.mcap"), header, rings)
        recorder = Recorder(job, MessageChannel(theirs, REQUESTS))
        take, flush = recorder._log.write_record, recorder._log.finish_chunk

        def take_slowly(kind: int, payload: ring.Payload) -> None:
            clock.wait_until(clock.now_ns() + 5_000_000)
            take(kind, payload)

        def note_flush() -> None:
            flushed.append(clock.now_ns())
            flush()

        monkeypatch.setattr(recorder._log, "write_record", take_slowly)
        monkeypatch.setattr(recorder._log, "finish_chunk", note_flush)
        recorder.record_until_stopped(lambda: True)
    for memory in rings.values():
        os.close(memory)
    assert len(read_log(tmp_path / "run.mcap").cycles) == 3000
    assert max(np.diff([0, *flushed])) <= 505_000_000
    assert len(flushed) >= 29


@pytest.mark.parametrize("end", ["SIGTERM", "the supervisor is gone"])
def test_it_ignores_ctrl_c_and_finishes_the_file_at_its_end(start: Start, cycle: Cycle, end: str) -> None:
    recording = start()
    assert next(recording.lines) == {"type": "Ready"}
    recording.process.send_signal(signal.SIGINT)
    recording.cycles.append(RecordKind.CYCLE, cycle(0))
    if end == "SIGTERM":
        recording.process.send_signal(signal.SIGTERM)
        assert recording.summary()["gaps"] == 0
    else:
        recording.control.shutdown(socket.SHUT_RDWR)
    assert recording.process.wait(DEADLINE_S) == 0
    log = read_log(recording.path)
    assert (len(log.cycles), log.complete) == (1, True)


def test_a_full_disk_is_reported_once_and_the_rings_are_drained_on(start: Start, cycle: Cycle) -> None:
    recording = start()
    assert next(recording.lines) == {"type": "Ready"}
    resource.prlimit(
        recording.process.pid, resource.RLIMIT_FSIZE, (recording.path.stat().st_size, resource.RLIM_INFINITY)
    )
    recording.cycles.append(RecordKind.CYCLE, cycle(0))
    error = next(recording.lines)
    assert "writing the log stopped" in error["sentence"]
    for number in range(500):  # many times the ring
        recording.cycles.append(RecordKind.CYCLE, cycle(number))
    summary = recording.finish()
    assert summary["error"] == error["sentence"]
    assert summary["messages"] == 0
    assert summary["unwritten"] > 0
    assert next(recording.lines, None) is None
    assert recording.process.wait(DEADLINE_S) == 1
    assert not read_log(recording.path).complete


def test_a_log_that_cannot_be_created_is_reported(start: Start, tmp_path: Path) -> None:
    path = tmp_path / "there"
    path.write_bytes(b"precious")
    recording = start(path=path)
    assert "cannot be written" in next(recording.lines)["sentence"]
    assert recording.process.wait(DEADLINE_S) == 1
    assert path.read_bytes() == b"precious"
