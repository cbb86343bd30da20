"""The recorder: what the rings carry is in the log, whatever happens to its process."""

import json
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.kit.awaited import DEADLINE_S

from dxlrun.channels import ring
from dxlrun.channels.child_processes import LateMetadata, LoopRuns, MessageChannel
from dxlrun.channels.event_records import LONGEST_EVENT, EventBody, EventCode, EventRing, Severity
from dxlrun.channels.logged_packets import LONGEST_BATCH, PacketBatch
from dxlrun.channels.ring import RecordKind, RingWriter, record_size
from dxlrun.log.log_reader import read_log
from dxlrun.log.recorder import _MOST_PER_TURN, REQUESTS, Recorder
from dxlrun.log.schemas import CycleSpan, LogTopic, RecorderJob
from dxlwire.clock import VirtualClock
from dxlwire.packets import PacketKind


@dataclass
class Inside:
    """A recorder of this process, the writers of its rings, and the supervisor's end of its channel."""

    recorder: Recorder
    writers: list[RingWriter]
    supervisor: MessageChannel


Make = Callable[..., Any]


@pytest.fixture
def inside(path, header, layout):
    """Make a recorder of rings with so many cycles."""

    @contextmanager
    def inside(kept: int = 64, rings: int = 1) -> Iterator[Inside]:
        size = kept * record_size(layout.size)
        memories = {
            f"loop/cycles{n or ''}": ring.create(f"cycles{n}", size, layout.size) for n in range(rings)
        }
        ours, theirs = socket.socketpair()
        with ours, theirs:
            job = RecorderJob(str(path), header, memories)
            recorder = Recorder(job, MessageChannel(theirs, REQUESTS))
            yield Inside(recorder, [*map(RingWriter, memories.values())], MessageChannel(ours, REQUESTS))
        for memory in memories.values():
            os.close(memory)

    return inside


def test_record_that_is_torn_or_of_another_robot_is_declared_not_written(inside, path, cycle):
    with inside() as one:
        (writer,) = one.writers
        writer.append(RecordKind.CYCLE, b"short")
        writer.append(RecordKind.CYCLE, cycle(1))
        at = writer.head
        writer.append(RecordKind.CYCLE, cycle(2))
        writer._bytes[64 + at + 40] ^= 1
        assert one.recorder.record_until_stopped(lambda: True).summary.gaps == 2
    assert read_log(path).cycles["cycle"] == [1]


@pytest.mark.parametrize(
    ("kept", "lost"), [(10, 90), (2 * _MOST_PER_TURN + 1000, 0), (2 * _MOST_PER_TURN, 7)]
)
def test_what_waits_at_the_end_is_drained_and_what_was_overwritten_is_declared(
    inside, path, cycle, kept, lost
):
    """A recorder that was stopped while it was behind: two turns and a half may be in the ring."""
    with inside(kept) as one:
        record = cycle(0)
        for _ in range(kept + lost):
            one.writers[0].append(RecordKind.CYCLE, record)
        one.supervisor.send_message(LateMetadata({"grants": {"loop": "none"}}))
        summary = one.recorder.record_until_stopped(lambda: True).summary
    log = read_log(path)
    assert len(log.cycles) + summary.gaps == kept + lost
    assert bool(summary.gaps) is bool(lost)
    assert [event.code for event in log.events] == [EventCode.RECORDER_GAP] * bool(lost)
    if lost == 90:
        assert "90 records of loop/cycles" in log.events[0].text
    assert log.metadata["grants"] == {"loop": "none"}


def test_machine_is_measured_from_the_begin_of_the_loop_to_its_end(inside, path, cycle):
    turns: list[int] = []
    with inside() as one:

        def asked_to_stop() -> bool:
            """Let the loop begin with cycles that are due long ago, and end after two samples."""
            turns.append(len(turns))
            if len(turns) == 2:
                one.writers[0].append(RecordKind.CYCLE, cycle(0))
            time.sleep(0.15)
            return len(turns) == 5

        one.supervisor.send_message(LoopRuns(os.getpid()))
        closed = one.recorder.record_until_stopped(asked_to_stop)
    (sample, *_) = read_log(path).messages(LogTopic.MACHINE)
    assert sample["loop_voluntary"] >= 0
    assert len(sample["idle"]) >= 1
    # the sample at the end covers half a second or more; the first cycle was due before it began
    assert closed.run_load.seconds > 0.4
    assert closed.start_up_load.seconds == 0


def test_recorder_that_is_short_of_processor_time_flushes_every_half_second(inside, path, cycle, monkeypatch):
    """Each record takes 20 ms, four hundred times as long as usual, and 750 wait in three rings."""
    clock, flushed = VirtualClock(0), list[int]()
    module = SimpleNamespace(monotonic=lambda: clock.now_ns() / 1e9, monotonic_ns=clock.now_ns)
    monkeypatch.setattr("dxlrun.log.recorder.time", module)
    with inside(250, rings=3) as one:
        for writer in one.writers:
            for number in range(250):
                writer.append(RecordKind.CYCLE, cycle(number))
        take, flush = one.recorder._log.write_record, one.recorder._log.finish_chunk

        def take_slowly(kind: int, payload: ring.Payload) -> None:
            clock.wait_until(clock.now_ns() + 20_000_000)
            take(kind, payload)

        def note_flush() -> None:
            flushed.append(clock.now_ns())
            flush()

        monkeypatch.setattr(one.recorder._log, "write_record", take_slowly)
        monkeypatch.setattr(one.recorder._log, "finish_chunk", note_flush)
        one.recorder.record_until_stopped(lambda: True)
    assert len(read_log(path).cycles) == 750
    assert max(np.diff([0, *flushed])) <= 520_000_000
    assert len(flushed) >= 28


# In a process of its own


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
    lines: Iterator[dict[str, Any]]

    def summary(self) -> dict[str, Any]:
        found: dict[str, Any] = next(line["summary"] for line in self.lines if "summary" in line)
        return found


Start = Callable[[], Recording]


@pytest.fixture
def start(path, header, layout, cycle):
    """Start a recorder whose first cycle is there before it is ready."""
    descriptors: list[int] = []
    started: list[Recording] = []

    def make() -> Recording:
        rings = {
            "loop/cycles": ring.create("cycles", 64 * record_size(layout.size), layout.size),
            "loop/packets": ring.create("packets", 4 * LONGEST_BATCH, LONGEST_BATCH),
            "loop/events": ring.create("events", 2 * LONGEST_EVENT, LONGEST_EVENT),
        }
        job_fd, span = os.memfd_create("job"), os.memfd_create("span")
        ours, theirs = socket.socketpair()
        ours.settimeout(DEADLINE_S)
        os.write(job_fd, msgspec.json.encode(RecorderJob(str(path), header, rings, span=span)))
        os.lseek(job_fd, 0, os.SEEK_SET)
        descriptors.extend([*rings.values(), job_fd, span])
        cycles, packets, events = map(RingWriter, rings.values())
        cycles.append(RecordKind.CYCLE, cycle(0))
        words = ["--job-fd", str(job_fd), "--control-fd", str(theirs.fileno())]
        process = subprocess.Popen(
            [sys.executable, "-m", "dxlrun.log.recorder", *words],
            pass_fds=[*rings.values(), job_fd, span, theirs.fileno()],
        )
        theirs.close()
        lines = (json.loads(line) for line in ours.makefile("rb"))
        ends = PacketBatch(packets), EventRing(events, VirtualClock(5))
        started.append(Recording(path, process, span, ours, cycles, *ends, lines))
        return started[-1]

    yield make
    for recording in started:
        recording.process.kill()
        recording.process.wait()
        recording.control.close()
    for descriptor in descriptors:
        os.close(descriptor)


@pytest.mark.parametrize("end", ["Finish", "SIGTERM", "the supervisor is gone"])
def test_what_the_rings_carry_is_in_the_log_byte_for_byte_and_ctrl_c_is_ignored(start, cycle, end):
    recording = start()
    assert next(recording.lines) == {"type": "Ready"}
    recording.process.send_signal(signal.SIGINT)
    sent = [bytes([255, 255, number]) for number in range(30)]
    for number in range(30):
        if number:
            recording.cycles.append(RecordKind.CYCLE, cycle(number))
        recording.packets.packet(0, PacketKind.STATUS, 1, number, number + 1, sent[number])
        recording.packets.commit_packets()
    recording.events.emit_event("loop", EventBody(EventCode.TORQUE_OFF, Severity.INFO, "every servo is limp"))
    if end == "SIGTERM":
        recording.process.send_signal(signal.SIGTERM)
    elif end == "Finish":
        recording.control.sendall(b'{"type": "Finish"}\n')
    else:
        recording.control.shutdown(socket.SHUT_RDWR)
    if end != "the supervisor is gone":
        summary = recording.summary()
        assert (summary["gaps"], summary["bytes"]) == (0, recording.path.stat().st_size)
    assert recording.process.wait(DEADLINE_S) == 0
    log = read_log(recording.path)
    assert log.cycles.tobytes() == b"".join(cycle(number) for number in range(30))
    assert [packet.data for packet in log.packets] == sent
    assert [event.text for event in log.events] == ["every servo is limp"]
    assert log.complete


def test_after_a_kill_the_log_is_readable_up_to_the_last_flush(start, cycle):
    recording = start()
    assert next(recording.lines) == {"type": "Ready"}
    for number in range(1, 20):
        recording.cycles.append(RecordKind.CYCLE, cycle(number))
    while CycleSpan.load(recording.span).last_ns is None:  # until a flush, which needs no help from here
        assert recording.process.poll() is None
    assert read_log(recording.path).being_written
    recording.process.send_signal(signal.SIGKILL)
    recording.process.wait()
    log = read_log(recording.path)
    assert (log.complete, log.being_written) == (False, False)
    last = CycleSpan(int(log.cycles["scheduled_ns"][0]), int(log.cycles["written_ns"][-1])).last_cycle_text
    assert log.damage == (f"the file ends early: the recorder was killed or could not write; {last}",)
    assert CycleSpan.load(recording.span).last_cycle_text == last
    assert log.cycles.tobytes() == b"".join(cycle(number) for number in range(20))


def test_full_disk_is_reported_once_and_the_rings_are_drained_on(start, cycle):
    recording = start()
    assert next(recording.lines) == {"type": "Ready"}
    limit = (recording.path.stat().st_size, resource.RLIM_INFINITY)
    resource.prlimit(recording.process.pid, resource.RLIMIT_FSIZE, limit)
    recording.cycles.append(RecordKind.CYCLE, cycle(0))
    error = next(recording.lines)
    assert "writing the log stopped" in error["sentence"]
    for number in range(500):  # many times the ring
        recording.cycles.append(RecordKind.CYCLE, cycle(number))
    recording.control.sendall(b'{"type": "Finish"}\n')
    lines = [line for line in recording.lines if line["type"] != "Draining"]
    (summary,) = (line["summary"] for line in lines)  # without the error once more
    assert (summary["error"], summary["messages"]) == (error["sentence"], 0)
    assert summary["unwritten"] > 0
    assert recording.process.wait(DEADLINE_S) == 1
    assert not read_log(recording.path).complete


def test_log_that_cannot_be_created_is_reported(start, path):
    path.write_bytes(b"precious")
    recording = start()
    assert "cannot be written" in next(recording.lines)["sentence"]
    assert recording.process.wait(DEADLINE_S) == 1
    assert path.read_bytes() == b"precious"
