"""A log in parts, split by size or time, all kept or the newest; read as a whole, and while it is written."""

import errno
import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import make_reader
from msgspec.structs import replace
from tests.kit.decoded import decode_log

from dxlrun.channels.event_records import EventBody, EventCode, EventRing, Severity
from dxlrun.channels.logged_packets import PacketBatch
from dxlrun.channels.ring import Handover, RecordKind
from dxlrun.errors import LogError
from dxlrun.log.log_file import LogFile
from dxlrun.log.log_reader import Log, LogFollower, open_log, read_log
from dxlrun.log.part_writer import PartWriter, open_writer
from dxlrun.log.schemas import LogHeader
from dxlrun.plan.recording_plan import PART_END_NAME, PART_NAME, RecordingPlan
from dxlrun_analysis.cycles.punctuality import Punctuality
from dxlwire.clock import VirtualClock
from dxlwire.packets import PacketKind

SECOND = 1_000_000_000
PER_SECOND = 50
"""Cycles of the fixture in a second."""
EACH_SECOND = RecordingPlan(split_ns=SECOND)
ROBOTS = Path(__file__).parents[2] / "robots"


class Run:
    """A run of cycles, each with a packet, into a log in parts."""

    def __init__(self, folder: Path, header: LogHeader, cycle: Callable[[int], bytes], plan: RecordingPlan):
        self.folder, self.log, self._cycle = folder, open_writer(folder, header, plan), cycle
        self._clock = VirtualClock()
        to_log = Handover(self.log.write_record)
        self._packets, self._events = PacketBatch(to_log), EventRing(to_log, self._clock)

    def event(self, text: str) -> None:
        """Report something now."""
        self._events.emit_event("head", EventBody(EventCode.CONTROLLER_SAYS, Severity.INFO, text))

    def cycles(self, first: int, end: int, step: int = 0) -> None:
        """Run some cycles: packets, then the cycle; `step`: a chunk for so many."""
        for number in range(first, end):
            t_ns = SECOND + number * SECOND // PER_SECOND
            self._clock.wait_until(t_ns)
            self._packets.wake(number)
            self._packets.packet(0, PacketKind.STATUS, 1, t_ns, t_ns + 10, bytes(8))
            self._packets.commit_packets()
            self.log.write_record(RecordKind.CYCLE, self._cycle(number))
            if isinstance(self.log, PartWriter):
                self.log.split_if_due()
            if step and (number + 1) % step == 0:
                self.log.finish_chunk()

    @property
    def parts(self) -> list[Path]:
        return sorted(self.folder.iterdir())

    @property
    def kept(self) -> list[int]:
        """Numbers of the cycles that are in the log."""
        return numbers(read_log(self.folder))


@pytest.fixture
def start(tmp_path, header, cycle):
    return lambda plan: Run(tmp_path / "run", header, cycle, plan)


@pytest.fixture
def four(start):
    """Four whole parts of 175 cycles."""
    run = start(EACH_SECOND)
    run.cycles(0, 175)
    run.log.close()
    return run.folder


def numbers(log: Log) -> list[int]:
    return log.cycles["cycle"].tolist()


def names(*parts: int) -> list[str]:
    return [f"part_{part:04d}.mcap" for part in parts]


def test_split_by_time_loses_nothing_and_reads_as_one(start):
    run = start(EACH_SECOND)
    run.cycles(0, 175)
    run.event("over")
    summary, log = run.log.close(), read_log(run.folder)
    assert [path.name for path in run.parts] == names(0, 1, 2, 3)
    assert numbers(log) == log.packets.cycle.tolist() == list(range(175))
    assert [event.text for event in log.events] == ["over"]
    assert (log.complete, log.damage) == (True, ())
    parts = [read_log(path) for path in run.parts]
    assert [part.metadata[PART_NAME]["began"] for part in parts] == ["start", "time", "time", "time"]
    assert [part.metadata[PART_END_NAME]["last"] for part in parts] == ["no", "no", "no", "yes"]
    assert [part.complete and bool(part.attachments["robot.yaml"]) for part in parts] == [True] * 4
    assert sum(len(part.cycles) for part in parts) == 175
    assert summary.bytes == sum(path.stat().st_size for path in run.parts)


def test_split_by_size_ends_a_part_at_its_size(start):
    run = start(RecordingPlan(split_bytes=20_000))
    run.cycles(0, 400, step=20)
    run.log.close()
    assert len(run.parts) > 2
    assert run.kept == list(range(400))


def test_parts_whose_newest_record_is_too_old_are_deleted(start):
    run = start(RecordingPlan(split_ns=SECOND, keep_ns=2 * SECOND))
    run.cycles(0, 3 * PER_SECOND)
    assert [path.name for path in run.parts] == names(0, 1, 2)
    run.cycles(3 * PER_SECOND, 10 * PER_SECOND)
    run.log.close()
    log = read_log(run.folder)
    assert [path.name for path in run.parts] == names(7, 8, 9)
    assert numbers(log) == list(range(numbers(log)[0], 10 * PER_SECOND))
    assert 2 * PER_SECOND <= len(log.cycles) <= 3 * PER_SECOND
    assert (log.complete, log.damage, log.part) == (True, (), 7)


def test_newest_part_is_kept_however_old_it_is(start):
    run = start(RecordingPlan(split_bytes=1 << 30, keep_ns=SECOND))
    run.cycles(0, 5 * PER_SECOND)
    run.log.close()
    assert run.kept == list(range(5 * PER_SECOND))


def test_log_that_a_full_disk_ended_loses_no_older_part(start, monkeypatch):
    run = start(RecordingPlan(split_ns=SECOND, keep_ns=2 * SECOND))
    run.cycles(0, 3 * PER_SECOND)

    def full(self: LogFile, data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(LogFile, "write", full)
    run.log.finish_chunk()
    run.cycles(3 * PER_SECOND, 20 * PER_SECOND)
    assert run.log.close().error
    assert run.kept[0] == 0


def test_part_that_cannot_be_deleted_stays(start, monkeypatch):
    def refused(self: Path, missing_ok: bool = False) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "unlink", refused)
    run = start(RecordingPlan(split_ns=SECOND, keep_ns=SECOND))
    run.cycles(0, 5 * PER_SECOND)
    assert run.log.close().error is None
    assert run.kept == list(range(5 * PER_SECOND))


@pytest.mark.parametrize("keep_ns", [None, SECOND])
def test_account_of_a_log_without_its_first_parts_begins_with_what_is_there(start, keep_ns):
    run = start(RecordingPlan(split_ns=SECOND, keep_ns=keep_ns))
    run.cycles(0, 5 * PER_SECOND)
    run.log.close()
    for name in names(0, 1, 2):
        (run.folder / name).unlink(missing_ok=True)
    reader, account = open_log(run.folder), Punctuality()
    for part_of_log in reader.slices():
        account.add_slice(part_of_log)
    periods, _ = account.compute_latency()
    count = len(run.kept)
    assert (periods.elapsed, periods.records, periods.missing, periods.agree) == (count, count, 0, True)
    assert periods.seconds == pytest.approx(count / PER_SECOND)
    assert reader.damage == (() if keep_ns else ("part_0000.mcap to part_0002.mcap are missing",))


def test_parts_of_a_robot_have_the_same_as_its_whole_log(torso):
    parts, whole = read_log(torso / "parts"), read_log(torso / "whole.mcap")
    assert parts.cycles.tobytes() == whole.cycles.tobytes()
    assert [*parts.packets] == [*whole.packets]
    assert (parts.commands, parts.events) == (whole.commands, whole.events)
    assert parts.topics.keys() == whole.topics.keys()
    assert [one.data for one in parts.topics.values()] == [whole.topics[name].data for name in parts.topics]
    assert parts.complete
    files = sorted((torso / "parts").iterdir())
    assert [file.name for file in files] == names(0, 1, 2)
    for file in files:  # each announces the topics again
        with file.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert sum(1 for _ in decode_log(file)) == summary.statistics.message_count > 0


# Parts that are missing, damaged, or none


@pytest.mark.parametrize(
    ("removed", "sentence"),
    [
        ((1,), "part_0001.mcap is missing"),
        ((0, 1), "part_0000.mcap to part_0001.mcap are missing"),
        ((3,), "the parts after part_0002.mcap are missing"),
    ],
)
def test_part_that_is_missing_is_damage(four, removed, sentence):
    for name in names(*removed):
        (four / name).unlink()
    log = read_log(four)
    assert (log.damage, log.complete) == ((sentence,), False)
    assert len(log.cycles) > 60


def test_other_files_in_the_directory_are_ignored(four):
    (four / "notes.txt").write_text("a match")
    (four / "part_x.mcap").write_text("none of ours")
    (four / "part_0009.mcap").mkdir()
    os.mkfifo(four / "part_0004.mcap")
    assert read_log(four).complete


@pytest.mark.parametrize("inside", ["", "other.mcap"])
def test_directory_without_a_part_is_one_sentence(inside, tmp_path):
    if inside:
        (tmp_path / inside).write_text("")
    with pytest.raises(LogError, match=r"the directory has no log \(part_0000"):
        read_log(tmp_path)


@pytest.mark.parametrize(
    ("target", "sentence"),
    [("", "this is a pipe or a device"), ("/dev/zero", "this is a pipe"), ("x.mcap", "cannot be read: ")],
    ids=["pipe", "device", "circle"],
)  # fmt: skip
def test_pipe_or_device_is_one_sentence(target, sentence, tmp_path):
    path = tmp_path / "x.mcap"
    path.symlink_to(target) if target else os.mkfifo(path)
    with pytest.raises(LogError, match=f"x.mcap: {sentence}"):
        read_log(path)


def test_empty_part_or_one_that_is_no_log_is_damage_and_the_others_are_read(four):
    (four / "part_0001.mcap").write_bytes(b"")
    (four / "part_0002.mcap").write_bytes(b"no log at all")
    log = read_log(four)
    assert log.damage == (
        "part_0001.mcap: the file is empty: the recorder wrote nothing",
        "part_0002.mcap: this is not an MCAP file; give a log of dxlrun",
    )
    assert len(log.cycles) > 60


def test_part_of_another_run_is_left_out(four, tmp_path, header):
    open_writer(tmp_path / "other.mcap", replace(header, robot="other"), RecordingPlan()).close()
    shutil.copy(tmp_path / "other.mcap", four / "part_0002.mcap")
    log = read_log(four)
    assert log.damage == ("part_0002.mcap belongs to another run and was skipped",)
    assert log.header.robot == "torso"


def test_part_that_was_cut_is_read_as_far_as_it_goes(four):
    part = four / "part_0001.mcap"
    part.write_bytes(part.read_bytes()[:-200])
    log = read_log(four)
    assert log.damage == ("part_0001.mcap ends early: the recorder was killed or could not write",)
    assert numbers(log)[-1] == 174


# While it is written


@pytest.mark.parametrize("keep_ns", [None, SECOND])
def test_follower_goes_from_part_to_part_also_when_older_ones_are_deleted(start, keep_ns):
    run = start(RecordingPlan(split_ns=SECOND, keep_ns=keep_ns))
    follower = LogFollower(run.folder)
    seen: list[int] = []
    for number in range(0, 475, 25):
        run.cycles(number, number + 25, step=25)
        seen += numbers(follower.new())
    run.log.close()
    assert seen + numbers(follower.new()) == list(range(475))


@pytest.mark.parametrize(("room", "parts"), [(0, [0]), (12_000, [0, 1])], ids=["opening", "within"])
def test_full_disk_ends_the_log_with_whole_parts(start, monkeypatch, room, parts):
    write, used = LogFile.write, 0

    def limited(self: LogFile, data: bytes | bytearray | memoryview) -> int:
        nonlocal used
        if "part_0001" in str(self._path):
            used += len(data)
            if used > room:
                raise OSError(errno.ENOSPC, "No space left on device")
        return write(self, data)

    monkeypatch.setattr(LogFile, "write", limited)
    run = start(EACH_SECOND)
    run.cycles(0, 300, step=10)
    summary = run.log.close()
    assert "No space left on device" in (summary.error or "")
    assert summary.unwritten > 100
    assert run.kept == list(range(len(run.kept)))
    assert 50 <= len(run.kept) < 110
    assert [path.name for path in run.parts] == names(*parts)
    assert not read_log(run.folder).complete


@pytest.mark.parametrize(
    ("kind", "sentence"), [(RecordKind.CYCLE, "buffer"), (RecordKind.TAGGED, "Expected")]
)
def test_record_that_is_none_is_refused_as_in_one_file(start, kind, sentence):
    run = start(EACH_SECOND)
    with pytest.raises(ValueError, match=sentence):
        run.log.write_record(kind, b"?")
    run.log.close()


# A log of one file that is being written: each look has what is new, once


@pytest.fixture
def written(log, path, cycle):
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
    return path.read_bytes()


@pytest.mark.parametrize("seed", range(5))
def test_everything_comes_once_however_the_file_grows(written, tmp_path, seed):
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


def test_follower_has_the_log_without_its_packets_and_misses_a_file_that_is_gone(written, path):
    whole, follower = read_log(path), LogFollower(path)
    followed = follower.new()
    assert whole.cycles.tobytes() == followed.cycles.tobytes()
    assert (len(whole.packets), len(followed.packets)) == (1, 0)
    assert (followed.attachments, followed.header) == (whole.attachments, whole.header)
    path.unlink()
    with pytest.raises(LogError, match="cannot be read"):
        follower.new()
