"""A log that is being written: each look gives what is new, once, wherever the file ended before."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import pytest

from dxlrun.channels.event_records import EventBody, EventCode, EventRing, Severity
from dxlrun.channels.logged_packets import PacketBatch
from dxlrun.channels.ring import Handover, RecordKind
from dxlrun.errors import LogError
from dxlrun.log.log_reader import LogFollower, read_log
from dxlrun.log.log_writer import LogWriter
from dxlwire.clock import VirtualClock
from dxlwire.packets import PacketKind


@pytest.fixture
def written(log: LogWriter, tmp_path: Path, cycle: Callable[[int], bytes]) -> bytes:
    """The bytes of a log with 400 cycles in 20 chunks and an event in each."""
    events = EventRing(Handover(log.write_record), VirtualClock())
    for number in range(400):
        log.write_record(RecordKind.CYCLE, cycle(number))
        if number % 20 == 19:
            events.emit_event("arm", EventBody(EventCode.CONTROLLER_SAYS, Severity.INFO, f"cycle {number}"))
            log.finish_chunk()
    batch = PacketBatch(Handover(log.write_record))
    batch.packet(0, PacketKind.INSTRUCTION, 1, 10, 11, bytes.fromhex("ffff0104022406ce"))
    batch.commit_packets()
    log.close()
    return (tmp_path / "run.mcap").read_bytes()


@pytest.mark.parametrize("seed", range(5))
def test_everything_comes_once_however_the_file_grows(written: bytes, tmp_path: Path, seed: int) -> None:
    rng, path = random.Random(seed), tmp_path / "growing.mcap"
    begin = written.index(b"plan.json") + 2000
    ends = sorted(rng.randrange(begin, len(written)) for _ in range(30))
    cycles, texts = [], []
    with path.open("wb", buffering=0) as file:
        file.write(written[:begin])
        follower = LogFollower(path)
        for end in (*ends, len(written), len(written)):
            file.write(written[file.tell() : end])
            new = follower.new()
            cycles += new.cycles["cycle"].tolist()
            texts += [event.text for event in new.events]
    assert cycles == list(range(400))
    assert texts == [f"cycle {number}" for number in range(19, 400, 20)]


def test_it_is_the_log_without_its_packets(written: bytes, tmp_path: Path) -> None:
    path = tmp_path / "whole.mcap"
    path.write_bytes(written)
    whole, followed = read_log(path), LogFollower(path).new()
    assert whole.cycles.tobytes() == followed.cycles.tobytes()
    assert len(whole.packets) == 1
    assert followed.attachments == whole.attachments
    assert followed.header == whole.header
    assert len(followed.packets) == 0


def test_a_file_that_is_gone_is_refused(written: bytes, tmp_path: Path) -> None:
    path = tmp_path / "gone.mcap"
    path.write_bytes(written)
    follower = LogFollower(path)
    follower.new()
    path.unlink()
    with pytest.raises(LogError, match="cannot be read"):
        follower.new()
