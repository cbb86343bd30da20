"""A log in parts, split by size or time, all kept or the newest; read as one, or one by one."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from msgspec import structs
from msgspec.structs import replace

from dxlrun.channels.event_records import EventBody, EventCode, EventRing, Severity
from dxlrun.channels.logged_packets import PacketBatch
from dxlrun.channels.ring import Handover, RecordKind
from dxlrun.errors import LogError
from dxlrun.log.log_file import LogFile
from dxlrun.log.log_reader import Log, LogFollower, open_log, read_log
from dxlrun.log.part_writer import PartWriter, open_writer
from dxlrun.log.schemas import LogHeader
from dxlrun.plan.recording_plan import PART_END_NAME, PART_NAME, RecordingPlan
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun.testing import plan_of
from dxlrun_analysis.cycles.punctuality import Punctuality
from dxlwire.clock import VirtualClock
from dxlwire.packets import PacketKind

SECOND = 1_000_000_000
PER_SECOND = 50
"""Cycles of the fixture in a second."""
ROBOTS = Path(__file__).parents[2] / "robots"


class Run:
    """A run of cycles, each with a packet and an event now and then, into a log in parts."""

    def __init__(self, path: Path, header: LogHeader, plan: RecordingPlan, cycle: Callable[[int], bytes]):
        self.log = open_writer(path, header, plan)
        self._cycle = cycle
        self._clock = VirtualClock()
        to_log = Handover(self.log.write_record)
        self._packets = PacketBatch(to_log)
        self._events = EventRing(to_log, self._clock)

    def event(self, text: str, severity: Severity = Severity.INFO) -> None:
        """Report something now."""
        self._events.emit_event("head", EventBody(EventCode.CONTROLLER_SAYS, severity, text))

    def cycles(self, first: int, end: int) -> None:
        """Run some cycles: packets, then the cycle."""
        for number in range(first, end):
            t_ns = SECOND + number * SECOND // PER_SECOND
            self._clock.wait_until(t_ns)
            self._packets.wake(number)
            self._packets.packet(0, PacketKind.STATUS, 1, t_ns, t_ns + 10, bytes(8))
            self._packets.commit_packets()
            self.log.write_record(RecordKind.CYCLE, self._cycle(number))
            if isinstance(self.log, PartWriter):
                self.log.split_if_due()


Start = Callable[[RecordingPlan], Run]


@pytest.fixture
def start(tmp_path: Path, header: LogHeader, cycle: Callable[[int], bytes]) -> Start:
    return lambda plan: Run(tmp_path / "run", header, plan, cycle)


def numbers(log: Log) -> list[int]:
    return log.cycles["cycle"].tolist()


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_without_split_a_log_is_one_file(tmp_path: Path, start: Start) -> None:
    run = start(RecordingPlan())
    run.cycles(0, 10)
    run.log.close()
    assert (tmp_path / "run").is_file()
    assert PART_NAME not in read_log(tmp_path / "run").metadata


def test_a_split_by_time_loses_nothing_and_reads_as_one(tmp_path: Path, start: Start) -> None:
    run = start(RecordingPlan(split_ns=SECOND))
    run.cycles(0, 175)
    run.event("over")
    summary = run.log.close()

    log = read_log(tmp_path / "run")
    assert names(tmp_path / "run") == [f"part_{index:04d}.mcap" for index in range(4)]
    assert numbers(log) == list(range(175))
    assert log.packets.cycle.tolist() == list(range(175))
    assert [event.text for event in log.events] == ["over"]
    assert (log.complete, log.damage) == (True, ())
    parts = [read_log(path) for path in sorted((tmp_path / "run").iterdir())]
    assert [part.metadata[PART_NAME]["began"] for part in parts] == ["start", "time", "time", "time"]
    assert [part.metadata[PART_END_NAME]["last"] for part in parts] == ["no", "no", "no", "yes"]
    assert all(part.complete and part.attachments["robot.yaml"] for part in parts)
    assert sum(len(part.cycles) for part in parts) == 175
    assert summary.bytes == sum(path.stat().st_size for path in (tmp_path / "run").iterdir())


def test_a_split_by_size_ends_a_part_at_its_size(tmp_path: Path, start: Start) -> None:
    run = start(RecordingPlan(split_bytes=20_000))
    for number in range(0, 400, 20):
        run.cycles(number, number + 20)
        run.log.finish_chunk()
    run.log.close()
    sizes = [path.stat().st_size for path in sorted((tmp_path / "run").iterdir())]
    assert len(sizes) > 2
    assert numbers(read_log(tmp_path / "run")) == list(range(400))


def test_parts_whose_newest_record_is_too_old_are_deleted(tmp_path: Path, start: Start) -> None:
    run = start(RecordingPlan(split_ns=SECOND, keep_ns=2 * SECOND))
    run.cycles(0, 3 * PER_SECOND)
    assert names(tmp_path / "run") == [f"part_000{part}.mcap" for part in range(3)]
    run.cycles(3 * PER_SECOND, 10 * PER_SECOND)
    run.log.close()

    log = read_log(tmp_path / "run")
    assert names(tmp_path / "run") == [f"part_000{part}.mcap" for part in (7, 8, 9)]
    kept = numbers(log)
    assert kept == list(range(kept[0], 10 * PER_SECOND))
    assert 2 * PER_SECOND <= len(kept) <= 3 * PER_SECOND
    assert (log.complete, log.damage, log.part) == (True, (), 7)


def test_the_newest_part_is_kept_however_old_it_is(tmp_path: Path, start: Start) -> None:
    run = start(RecordingPlan(split_bytes=1 << 30, keep_ns=SECOND))
    run.cycles(0, 5 * PER_SECOND)
    run.log.close()
    assert numbers(read_log(tmp_path / "run")) == list(range(5 * PER_SECOND))


def test_a_log_that_a_full_disk_ended_loses_no_older_part(
    tmp_path: Path, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = start(RecordingPlan(split_ns=SECOND, keep_ns=2 * SECOND))
    run.cycles(0, 3 * PER_SECOND)

    def full(self: LogFile, data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(LogFile, "write", full)
    run.log.finish_chunk()
    run.cycles(3 * PER_SECOND, 20 * PER_SECOND)
    assert run.log.close().error
    assert numbers(read_log(tmp_path / "run"))[0] == 0


def test_a_part_that_cannot_be_deleted_stays(
    tmp_path: Path, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(self: Path, missing_ok: bool = False) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "unlink", refused)
    run = start(RecordingPlan(split_ns=SECOND, keep_ns=SECOND))
    run.cycles(0, 5 * PER_SECOND)
    assert run.log.close().error is None
    assert numbers(read_log(tmp_path / "run")) == list(range(5 * PER_SECOND))


@pytest.mark.parametrize("keep_ns", [None, SECOND])
def test_the_account_of_a_log_without_its_first_parts_begins_with_what_is_there(
    tmp_path: Path, start: Start, keep_ns: int | None
) -> None:
    run = start(RecordingPlan(split_ns=SECOND, keep_ns=keep_ns))
    run.cycles(0, 5 * PER_SECOND)
    run.log.close()
    for part in (0, 1, 2):
        (tmp_path / f"run/part_000{part}.mcap").unlink(missing_ok=True)
    reader, account = open_log(tmp_path / "run"), Punctuality()
    for part_of_log in reader.slices():
        account.add_slice(part_of_log)
    periods, _ = account.compute_latency()
    count = len(read_log(tmp_path / "run").cycles)
    assert (periods.elapsed, periods.records, periods.missing, periods.agree) == (count, count, 0, True)
    assert periods.seconds == pytest.approx(count / PER_SECOND)
    assert reader.damage == (() if keep_ns else ("part_0000.mcap to part_0002.mcap are missing",))


def test_each_part_announces_the_topics_again(tmp_path: Path, header: LogHeader, cycle: object) -> None:
    robot = plan_of(ROBOTS / "bioloid_torso.yaml", duration_s=3.5, play=[ROBOTS / "motions/three_parts.yaml"])
    plan = structs.replace(robot, recording=RecordingPlan(split_ns=SECOND))
    VirtualRobot(plan, log=tmp_path / "parts").run()
    VirtualRobot(robot, log=tmp_path / "whole.mcap").run()

    parts, whole = read_log(tmp_path / "parts"), read_log(tmp_path / "whole.mcap")
    assert len(names(tmp_path / "parts")) == 4
    assert parts.cycles.tobytes() == whole.cycles.tobytes()
    assert [*parts.packets] == [*whole.packets]
    assert (parts.commands, parts.events) == (whole.commands, whole.events)
    assert parts.topics.keys() == whole.topics.keys()
    assert [parts.topics[name].data for name in parts.topics] == [
        whole.topics[name].data for name in parts.topics
    ]
    assert parts.complete
    for path in (tmp_path / "parts").iterdir():
        with path.open("rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            summary = reader.get_summary()
            assert summary is not None
            assert summary.statistics is not None
            assert sum(1 for _ in reader.iter_decoded_messages()) == summary.statistics.message_count


def test_two_runs_on_virtual_time_keep_the_same_parts_to_the_bit(tmp_path: Path) -> None:
    plan = plan_of(ROBOTS / "bioloid_torso.yaml", duration_s=4)
    plan = structs.replace(plan, recording=RecordingPlan(split_ns=SECOND, keep_ns=SECOND // 2))
    for name in ("once", "again"):
        robot = VirtualRobot(plan, log=tmp_path / name)
        robot.run()
    assert names(tmp_path / "once") == names(tmp_path / "again") == ["part_0003.mcap", "part_0004.mcap"]
    for name in names(tmp_path / "once"):
        assert (tmp_path / "once" / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


@pytest.fixture
def four(tmp_path: Path, start: Start) -> Path:
    """Four whole parts."""
    run = start(RecordingPlan(split_ns=SECOND))
    run.cycles(0, 175)
    run.log.close()
    return tmp_path / "run"


@pytest.mark.parametrize(
    ("removed", "sentence"),
    [
        ((1,), "part_0001.mcap is missing"),
        ((0, 1), "part_0000.mcap to part_0001.mcap are missing"),
        ((3,), "the parts after part_0002.mcap are missing"),
    ],
)
def test_a_part_that_is_missing_is_damage(four: Path, removed: tuple[int, ...], sentence: str) -> None:
    for part in removed:
        (four / f"part_000{part}.mcap").unlink()
    log = read_log(four)
    assert log.damage == (sentence,)
    assert not log.complete
    assert len(log.cycles) > 60


def test_other_files_in_the_directory_are_ignored(four: Path) -> None:
    (four / "notes.txt").write_text("a match")
    (four / "part_x.mcap").write_text("none of ours")
    (four / "part_0009.mcap").mkdir()
    assert read_log(four).complete


@pytest.mark.parametrize("inside", ["nothing", "other files"])
def test_a_directory_without_a_part_is_one_sentence(inside: str, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    if inside == "other files":
        (tmp_path / "run/other.mcap").write_text("")
    with pytest.raises(LogError, match=r"the directory has no log \(part_0000"):
        read_log(tmp_path / "run")


def test_a_pipe_or_a_device_is_one_sentence_and_none_of_the_parts(four: Path, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mcap")
    (tmp_path / "zero.mcap").symlink_to("/dev/zero")
    (tmp_path / "self.mcap").symlink_to("self.mcap")
    for name, sentence in (
        ("pipe.mcap", "this is a pipe or a device"),
        ("zero.mcap", "this is a pipe or a device"),
        ("self.mcap", "cannot be read: "),
    ):
        with pytest.raises(LogError, match=rf"{name}: {sentence}"):
            read_log(tmp_path / name)
    os.mkfifo(four / "part_0004.mcap")
    assert read_log(four).complete


def test_an_empty_part_or_one_that_is_no_log_is_damage_and_the_others_are_read(four: Path) -> None:
    (four / "part_0001.mcap").write_bytes(b"")
    (four / "part_0002.mcap").write_bytes(b"no log at all")
    log = read_log(four)
    assert log.damage == (
        "part_0001.mcap: the file is empty: the recorder wrote nothing",
        "part_0002.mcap: this is not an MCAP file; give a log of dxlrun",
    )
    assert len(log.cycles) > 60


def test_a_part_of_another_run_is_left_out(four: Path, tmp_path: Path, header: LogHeader) -> None:
    other = open_writer(tmp_path / "other.mcap", replace(header, robot="other"), RecordingPlan())
    other.close()
    shutil.copy(tmp_path / "other.mcap", four / "part_0002.mcap")
    log = read_log(four)
    assert log.damage == ("part_0002.mcap belongs to another run and was skipped",)
    assert log.header.robot == "torso"


def test_a_part_that_was_cut_is_read_as_far_as_it_goes(four: Path) -> None:
    part = four / "part_0001.mcap"
    part.write_bytes(part.read_bytes()[:-200])
    log = read_log(four)
    assert log.damage == ("part_0001.mcap ends early: the recorder was killed or could not write",)
    assert numbers(log)[-1] == 174


@pytest.mark.parametrize("keep_ns", [None, SECOND])
def test_a_follower_goes_from_part_to_part_also_when_older_ones_are_deleted(
    tmp_path: Path, start: Start, keep_ns: int | None
) -> None:
    run = start(RecordingPlan(split_ns=SECOND, keep_ns=keep_ns))
    follower = LogFollower(tmp_path / "run")
    seen: list[int] = []
    for number in range(0, 475, 25):
        run.cycles(number, number + 25)
        run.log.finish_chunk()
        seen += numbers(follower.new())
    run.log.close()
    seen += numbers(follower.new())
    assert seen == list(range(475))


@pytest.mark.parametrize("when", ["opening the second", "within the second"])
def test_a_disk_that_is_full_ends_the_log_with_whole_parts(
    tmp_path: Path, start: Start, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    write, room = LogFile.write, 0

    def limited(self: LogFile, data: bytes | bytearray | memoryview) -> int:
        nonlocal room
        if "part_0001" in str(self._path):
            room += len(data)
            if room > (0 if when.startswith("opening") else 12_000):
                raise OSError(errno.ENOSPC, "No space left on device")
        return write(self, data)

    monkeypatch.setattr(LogFile, "write", limited)
    run = start(RecordingPlan(split_ns=SECOND))
    for number in range(0, 300, 10):
        run.cycles(number, number + 10)
        run.log.finish_chunk()
    summary = run.log.close()

    assert summary.error is not None
    assert "No space left on device" in summary.error
    assert summary.unwritten > 100
    log = read_log(tmp_path / "run")
    assert numbers(log) == list(range(len(log.cycles)))
    assert 50 <= len(log.cycles) < 110
    assert names(tmp_path / "run") == [f"part_000{part}.mcap" for part in range(1 + (when[0] == "w"))]
    assert not log.complete


def test_a_record_that_is_none_is_refused_as_in_one_file(start: Start) -> None:
    run = start(RecordingPlan(split_ns=SECOND))
    for kind, sentence in ((RecordKind.CYCLE, "buffer"), (RecordKind.TAGGED, "Expected")):
        with pytest.raises(ValueError, match=sentence):
            run.log.write_record(kind, b"?")
    run.log.close()
