"""The log: what goes in comes out, for us and for other people's tools, also from a full disk."""

import json
import os
import resource
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lz4.frame
import msgspec
import numpy as np
import pytest
import yaml
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from msgspec import structs
from tests.kit.decoded import Decoded, decode_log

from dxlrun.channels.event_records import (
    MOST_FAILED,
    Event,
    EventBody,
    EventCode,
    EventRing,
    GoalReport,
    Severity,
)
from dxlrun.channels.logged_packets import LoggedPacket, PacketBatch
from dxlrun.channels.ring import Handover, RecordKind
from dxlrun.errors import LogError
from dxlrun.log import schemas
from dxlrun.log.log_reader import read_log
from dxlrun.log.log_writer import LogWriter
from dxlrun.log.reading import chunks
from dxlrun.log.schemas import LogSummary, from_metadata, to_metadata
from dxlwire.clock import VirtualClock
from dxlwire.packets import PacketKind

Cycle = Callable[[int], bytes]
PACKETS = [
    LoggedPacket(0, PacketKind.INSTRUCTION, 1, 10, 11, bytes.fromhex("ffff0104022406ce")),
    LoggedPacket(0, PacketKind.STATUS, 1, 600_000, 600_001, bytes.fromhex("ffff01080000020000000000f4")),
    LoggedPacket(1, PacketKind.NOISE, 254, 5, 5, b"\xff"),
]
EVENTS = [
    Event(7_000, EventCode.LOOP_STARTED, Severity.INFO, "loop", "50 Hz"),
    Event(7_000, EventCode.CONTROLLER_FAULT, Severity.ERROR, "head", "Traceback\n" + "ä" * 600),
    Event(7_000, EventCode.STEERED, Severity.INFO, "loop", "in words", data=b'{"kind":"pause"}'),
]


def fill(log: LogWriter, cycle: Cycle, cycles: int = 10) -> LogSummary:
    for number in range(cycles):
        log.write_record(RecordKind.CYCLE, cycle(number))
    batch = PacketBatch(Handover(log.write_record))
    for packet in PACKETS:
        batch.packet(packet.bus, packet.kind, packet.servo_id, packet.first_ns, packet.last_ns, packet.data)
    batch.commit_packets()
    ring = EventRing(Handover(log.write_record), VirtualClock(7_000))
    for event in EVENTS:
        ring.emit_event(event.source, EventBody(event.code, Severity(event.severity), event.text), event.data)
    return log.close()


def test_everything_comes_back_as_it_was(log, path, header, layout, cycle):
    summary = fill(log, cycle)
    read = read_log(path)
    assert read.cycles.tobytes() == b"".join(cycle(number) for number in range(10))
    assert read.cycles.dtype == layout.dtype
    assert list(read.packets) == PACKETS
    assert list(read.events) == EVENTS
    assert (read.joints, read.buses, read.controllers) == (header.joints, header.buses, header.controllers)
    assert (read.period_ns, read.header.epoch_offset_ns) == (header.period_ns, header.epoch_offset_ns)
    assert read.attachments["robot.yaml"] == b"name: torso\n"
    assert set(read.attachments) == {"robot.yaml", "plan.json", "header.json"}
    assert read.metadata["versions"] == {"dxlrun": "0.1.0"}
    assert (read.complete, read.damage) == (True, ())
    assert summary == LogSummary(summary.messages, path.stat().st_size, 0)
    assert log.close() is summary
    fill(LogWriter(path.with_name("again"), header), cycle)
    assert path.with_name("again").read_bytes() == path.read_bytes()
    before = path.read_bytes()
    with pytest.raises(FileExistsError):
        LogWriter(path, header)
    assert path.read_bytes() == before


def test_other_tools_decode_every_topic(log, path, header, cycle, typestore):
    summary, by_topic = fill(log, cycle), dict[str, list[Decoded]]()
    for one in decode_log(path):
        assert (one.schema.encoding, one.channel.message_encoding) == ("ros2msg", "cdr")
        assert one.channel.metadata["topic_type_hash"].startswith("RIHS01_")
        by_topic.setdefault(one.topic, []).append(one)
    assert {topic: len(messages) for topic, messages in by_topic.items()} == {
        "/cycle": 10, "/joint_commands": 10, "/joint_states": 5, "/diagnostics": 1,
        "/bus/main": 1, "/bus/second": 1, "/events": len(EVENTS), "/rosout": len(EVENTS),
    }  # fmt: skip
    assert sum(len(messages) for messages in by_topic.values()) == summary.messages
    state = by_topic["/joint_states"][1].message  # cycle 2
    assert (list(state.name), list(state.position)) == (list(header.joints[1:]), [2.2, 2.3])
    assert bytes(by_topic["/bus/main"][0].message.data) == PACKETS[0].data + PACKETS[1].data
    with path.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        found = [(message.log_time, message.data) for _, _, message in reader.iter_messages("/joint_states")]
    for number, (t_ns, data) in zip(range(0, 10, 2), found, strict=True):
        message: Any = typestore.deserialize_cdr(data, "sensor_msgs/msg/JointState")
        assert t_ns == header.epoch_offset_ns + 1_005_000_000 + number * header.period_ns
        unknown = np.isnan([message.position, message.velocity, message.effort])
        assert unknown.tolist() == [[number % 3 == 0, False]] * 3


def test_gap_is_an_event_and_counted_and_long_data_of_an_event_are_left_out(log, path):
    ring = EventRing(Handover(log.write_record), VirtualClock(7))
    ring.emit_event("loop", EventBody(EventCode.STEERED, Severity.INFO, "too long"), b"x" * 5000)
    log.gap("loop/packets", 17)
    assert log.close().gaps == 17
    read = read_log(path)
    long, gap = read.events
    assert (long.text, long.data) == ("too long", b"")
    assert (gap.code, gap.severity) == (EventCode.RECORDER_GAP, Severity.ERROR)
    assert "17 records of loop/packets" in gap.text
    assert json.loads(gap.data) == {"ring": "loop/packets", "lost": 17}
    assert read.metadata["dxlrun_summary"]["gaps"] == "17"


def test_failed_goals_of_clients_hide_none_of_a_motion_file(log):
    ring = EventRing(Handover(log.write_record), VirtualClock(7))
    ring.goals.planned = {"motion.yaml:7:5"}
    reports = [GoalReport(n, "arm", "trajectory", "a client", "missed") for n in range(MOST_FAILED + 50)]
    reports.append(GoalReport(999, "arm", "trajectory", "motion.yaml:7:5", "missed"))
    for report in reports:
        body = EventBody(EventCode.GOAL_ENDED, Severity.WARNING, "")
        ring.emit_event("arm", body, msgspec.json.encode(report))
    log.close()
    assert ring.totals.goals.failed == (*reports[:MOST_FAILED], reports[-1])


# What is no log, and logs of other versions


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "the file is empty"),
        (b"name: torso\n", "not an MCAP file"),
        (b"SQLite format 3\0x", "a ROS 2 bag in SQLite"),
        (b"\x89MCAP0\r\n", "is not a log of dxlrun"),
        (None, "No such file"),
    ],
)
def test_what_is_no_log_is_refused_with_a_sentence(path, content, sentence):
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(LogError, match=sentence):
        read_log(path)


def test_metadata_of_format_8_and_without_units_of_sources_are_read(header):
    text = to_metadata(structs.replace(header, source_units={"imu/voltage": "V"}))
    assert text["format"] == "9"
    assert from_metadata(text | {"format": "8"}) == from_metadata(text)
    assert from_metadata(text).source_units == {"imu/voltage": "V"}
    del text["source_units"]
    assert from_metadata(text) == structs.replace(header, attachments={}, metadata={}, robot_description=None)


OTHER_FORMAT = "and this version reads formats 8 and 9 only; use the version of dxlrun that recorded it"


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"format": "7"}, f"it has log format 7, {OTHER_FORMAT}"),
        ({"format": "99"}, f"it has log format 99, {OTHER_FORMAT}"),
        ({"format": None}, f"it has log format none, {OTHER_FORMAT}"),
        ({"joints": "{"}, "cannot read the log: the metadata .* is missing or wrong"),
        ({"joints": "[1]"}, "cannot read the log: the metadata .* is missing or wrong"),
        ({"joints": None}, "cannot read the log: the metadata 'joints' is missing or wrong"),
    ],
    ids=str,
)
def test_log_of_another_format_or_with_wrong_metadata_is_refused(path, header, monkeypatch, wrong, sentence):
    written = {name: value for name, value in (to_metadata(header) | wrong).items() if value is not None}
    monkeypatch.setattr("dxlrun.log.log_writer.to_metadata", lambda header: written)
    LogWriter(path, header).close()
    with pytest.raises(LogError, match=sentence):
        read_log(path)


# Chunks and attachments that are wrong, or that other tools wrote


@pytest.fixture
def rewritten(log, path, cycle):
    """Write a log of four chunks, the third of which is changed by hand."""

    def rewritten(change: Callable[[Chunk], object]) -> Path:
        for number in range(4):
            log.write_record(RecordKind.CYCLE, cycle(number))
            log.finish_chunk()
        log.close()
        with path.open("rb") as stream:
            records = [*StreamReader(stream, emit_chunks=True).records]
        change([record for record in records if isinstance(record, Chunk)][2])
        with path.open("wb") as stream:
            stream.write(b"\x89MCAP0\r\n")
            for record in records:
                builder = RecordBuilder()
                record.write(builder)
                stream.write(builder.end())
            stream.write(b"\x89MCAP0\r\n")
        return path

    return rewritten


def compressed(name: str, data: bytes) -> dict[str, object]:
    """Return a chunk whose data became others, without a checksum."""
    pack = {"lz4": lz4.frame.compress, "zstd": zstandard.compress}[name]
    return {"compression": name, "data": pack(data), "uncompressed_crc": 0}


TOO_LONG = "it is {} bytes long when decompressed, and 67108864 are read at most"


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"uncompressed_size": 1 << 40}, TOO_LONG.format(1 << 40)),
        ({"uncompressed_size": 2**64 - 1}, TOO_LONG.format(2**64 - 1)),
        ({"compression": "rar"}, "its compression 'rar' is not known"),
        (compressed("zstd", bytes(40 << 20)), "it has the wrong length"),  # and is not decompressed further
        (compressed("lz4", bytes(40 << 20)), "it has the wrong length"),
    ],
    ids=["long", "longest", "rar", "long zstd", "long lz4"],
)
def test_chunk_that_cannot_be_read_is_left_out_without_much_memory(rewritten, change, why):
    path = rewritten(lambda chunk: [setattr(chunk, *each) for each in change.items()])
    read_log(path)  # modules that are imported for it are not counted
    tracemalloc.start()
    try:
        log = read_log(path)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert log.cycles["cycle"].tolist() == [0, 1, 3]
    assert log.damage == (f"a chunk of messages is damaged and skipped: {why}",)
    assert most < 10 << 20


def test_file_becomes_only_so_many_times_as_long(rewritten, monkeypatch):
    monkeypatch.setattr(chunks, "_LARGEST", 2 << 20)
    monkeypatch.setattr(chunks, "_MOST_EXPANDED", 0)
    wrong = compressed("zstd", bytes(2 << 20)) | {"uncompressed_size": 2 << 20}
    log = read_log(rewritten(lambda chunk: [setattr(chunk, *each) for each in wrong.items()]))
    assert "becomes more than 0 times as long when decompressed" in log.damage[0]


@pytest.mark.parametrize("compression", ["lz4", ""])
def test_log_that_another_tool_compressed_is_read(rewritten, compression):
    def change(chunk: Chunk) -> None:
        data = zstandard.decompress(chunk.data)
        chunk.data = lz4.frame.compress(data) if compression else data
        chunk.compression = compression

    log = read_log(rewritten(change))
    assert (log.cycles["cycle"].tolist(), log.complete) == ([0, 1, 2, 3], True)


def test_long_attachment_is_compressed_and_comes_back(path, header):
    plan = json.dumps(list(range(20_000))).encode()
    LogWriter(path, structs.replace(header, attachments={"plan.json": plan, "robot.yaml": b"r"})).close()
    with path.open("rb") as stream:
        attached = {one.name: (one.media_type, one.data) for one in make_reader(stream).iter_attachments()}
    assert set(attached) == {"plan.json.zst", "robot.yaml", "header.json"}
    media, data = attached["plan.json.zst"]
    assert (media, zstandard.decompress(data)) == ("application/zstd", plan)
    assert read_log(path).attachments["plan.json"] == plan


@pytest.mark.parametrize(
    "data",
    [zstandard.compress(bytes(65 << 20)), zstandard.compress(bytes(range(256)) * 2000)[:-20], b"no zstd"],
    ids=["too long", "cut", "no zstd"],
)
def test_compressed_attachment_that_is_wrong_is_left_out(path, header, data):
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(schemas.PROFILE)
        writer.add_metadata(schemas.METADATA_NAME, to_metadata(header))
        writer.add_attachment(0, 0, "plan.json.zst", "application/zstd", data)
        writer.finish()
    read = read_log(path)
    assert "plan.json" not in read.attachments
    assert "a record of kind attachment cannot be read" in read.damage[0]


def test_mode_that_is_none_is_reported(log, path, cycle, layout):
    record = np.frombuffer(bytearray(cycle(7)), dtype=layout.dtype)
    record["mode"][0, 1] = 77
    log.write_record(RecordKind.CYCLE, record.tobytes())
    log.close()
    with pytest.raises(LogError, match="cycle 7 has an unknown mode of a servo"):
        read_log(path)


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_full_disk_stops_the_writing_and_leaves_a_readable_log(log, path, cycle):
    log.write_record(RecordKind.CYCLE, cycle(0))
    log.finish_chunk()
    whole = path.stat().st_size
    with files_of_at_most(whole + 100):
        log.write_record(RecordKind.CYCLE, cycle(1))
        log.finish_chunk()
        assert log.error is not None
        log.write_record(RecordKind.CYCLE, cycle(2))
        log.finish_chunk()
        summary = log.close()
    assert path.stat().st_size == whole == summary.bytes
    assert summary.error is not None
    assert summary.messages == 4  # cycle, states, commands, diagnostics of the first
    assert summary.unwritten > 2
    read = read_log(path)
    assert (len(read.cycles), read.complete) == (1, False)


def test_chunk_of_which_the_disk_takes_a_part_at_a_time_is_whole(log, path, cycle, monkeypatch):
    write = os.write
    monkeypatch.setattr(os, "write", lambda file, data: write(file, data[:100]))
    log.write_record(RecordKind.CYCLE, cycle(0))
    assert log.close().error is None
    assert read_log(path).complete


def test_disk_that_is_full_at_the_end_is_reported(log, path, cycle):
    log.write_record(RecordKind.CYCLE, cycle(0))
    with files_of_at_most(path.stat().st_size):
        summary = log.close()
    assert summary.error is not None
    assert summary.messages == 0


@pytest.mark.parametrize("what", ["deleted", "moved", "replaced", "cut"])
def test_file_that_is_gone_or_cut_is_reported(log, path, cycle, what):
    elsewhere = path.with_name("elsewhere.mcap")
    log.write_record(RecordKind.CYCLE, cycle(0))
    log.finish_chunk()
    if what == "cut":
        os.truncate(path, 100)
        log.write_record(RecordKind.CYCLE, cycle(1))
        assert log.close().error == "writing the log stopped: another program truncated the file"
        assert path.stat().st_size == 100  # without a hole
        return
    path.rename(elsewhere)
    if what == "deleted":
        elsewhere.unlink()
    if what == "replaced":
        path.write_bytes(b"another")
    assert log.close().error == "another program deleted or moved the file during the run"


def test_the_urdf_comes_first_and_once(header, cycle, path):
    writer = LogWriter(path, structs.replace(header, robot_description="<robot name='körper'/>"))
    for number in range(3):
        writer.write_record(RecordKind.CYCLE, cycle(number))
    summary = writer.close()
    first, second, *rest = decode_log(path, in_order=False)
    assert (first.topic, first.message.data) == ("/robot_description", "<robot name='körper'/>")
    assert first.t_ns == second.t_ns  # the run begins with its first record
    assert "/robot_description" not in {one.topic for one in (second, *rest)}
    assert len(rest) + 2 == summary.messages
    (profile,) = yaml.safe_load(first.channel.metadata["offered_qos_profiles"])
    assert (profile["durability"], profile["reliability"], profile["history"]) == (1, 1, 1)
    assert profile["deadline"] == {"sec": 9223372036, "nsec": 854775807}
    assert first.channel.metadata["topic_type_hash"] == schemas.STRING.type_hash
