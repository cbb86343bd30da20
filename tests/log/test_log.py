"""The log: what goes in comes out, for us and for other people's tools."""

from __future__ import annotations

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
from mcap_ros2.decoder import DecoderFactory
from msgspec import structs
from rosbags.typesys.store import Typestore

from dxlrun.channels.cycle import CycleLayout
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
from dxlrun.log.schemas import LogHeader, LogSummary, from_metadata, to_metadata
from dxlwire.clock import VirtualClock
from dxlwire.packets import PacketKind

Cycle = Callable[[int], bytes]
PACKETS = [
    LoggedPacket(0, PacketKind.INSTRUCTION, 1, 10, 11, bytes.fromhex("ffff0104022406ce")),
    LoggedPacket(0, PacketKind.STATUS, 1, 600_000, 600_001, bytes.fromhex("ffff01080000020000000000f4")),
    LoggedPacket(1, PacketKind.NOISE, 254, 5, 5, b"\xff"),
]
SAID = [
    (EventCode.LOOP_STARTED, Severity.INFO, "loop", "50 Hz"),
    (EventCode.CONTROLLER_FAULT, Severity.ERROR, "head", "Traceback\n" + "ä" * 600),
]


def fill(log: LogWriter, cycle: Cycle, cycles: int = 10) -> LogSummary:
    for number in range(cycles):
        log.write_record(RecordKind.CYCLE, cycle(number))
    batch = PacketBatch(Handover(log.write_record))
    for packet in PACKETS:
        batch.packet(packet.bus, packet.kind, packet.servo_id, packet.first_ns, packet.last_ns, packet.data)
    batch.commit_packets()
    events = EventRing(Handover(log.write_record), VirtualClock(7_000))
    for code, severity, source, text in SAID:
        events.emit_event(source, EventBody(code, severity, text))
    return log.close()


def test_everything_comes_back_as_it_was(
    log: LogWriter, tmp_path: Path, header: LogHeader, layout: CycleLayout, cycle: Cycle
) -> None:
    summary = fill(log, cycle)
    read = read_log(tmp_path / "run.mcap")
    assert read.cycles.tobytes() == b"".join(cycle(number) for number in range(10))
    assert read.cycles.dtype == layout.dtype
    assert list(read.packets) == PACKETS
    assert list(read.events) == [Event(7_000, *said) for said in SAID]
    assert (read.joints, read.buses, read.controllers) == (header.joints, header.buses, header.controllers)
    assert (read.period_ns, read.header.epoch_offset_ns) == (header.period_ns, header.epoch_offset_ns)
    assert read.attachments["robot.yaml"] == b"name: torso\n"
    assert set(read.attachments) == {"robot.yaml", "plan.json", "header.json"}
    assert read.metadata["versions"] == {"dxlrun": "0.1.0"}
    assert (read.complete, read.damage) == (True, ())
    assert summary == LogSummary(summary.messages, (tmp_path / "run.mcap").stat().st_size, 0)
    assert log.close() is summary


def test_the_data_of_an_event_come_back(log: LogWriter, tmp_path: Path) -> None:
    ring = EventRing(Handover(log.write_record), VirtualClock(7))
    ring.emit_event("loop", EventBody(EventCode.STEERED, Severity.INFO, "in words"), b'{"kind":"pause"}')
    ring.emit_event("loop", EventBody(EventCode.STEERED, Severity.INFO, "too long"), b"x" * 5000)
    log.gap("loop/packets", 3)
    log.close()
    first, long, gap = read_log(tmp_path / "run.mcap").events
    assert first == Event(7, EventCode.STEERED, Severity.INFO, "loop", "in words", data=b'{"kind":"pause"}')
    assert (long.text, long.data) == ("too long", b"")
    assert json.loads(gap.data) == {"ring": "loop/packets", "lost": 3}


def test_failed_goals_of_clients_hide_none_of_a_motion_file(log: LogWriter) -> None:
    ring = EventRing(Handover(log.write_record), VirtualClock(7))
    ring.goals.planned = {"motion.yaml:7:5"}
    for number in range(MOST_FAILED + 50):
        report = GoalReport(number, "arm", "trajectory", "a client", "missed")
        ring.emit_event(
            "arm", EventBody(EventCode.GOAL_ENDED, Severity.WARNING, ""), msgspec.json.encode(report)
        )
    planned = GoalReport(999, "arm", "trajectory", "motion.yaml:7:5", "missed")
    ring.emit_event(
        "arm", EventBody(EventCode.GOAL_ENDED, Severity.WARNING, ""), msgspec.json.encode(planned)
    )
    log.close()
    assert len(ring.totals.goals.failed) == MOST_FAILED + 1
    assert ring.totals.goals.failed[-1] == planned


def test_mcap_ros2_support_decodes_every_topic(
    log: LogWriter, tmp_path: Path, header: LogHeader, cycle: Cycle
) -> None:
    summary = fill(log, cycle)
    by_topic: dict[str, list[Any]] = {}
    with (tmp_path / "run.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert schema is not None
            assert schema.encoding == "ros2msg"
            assert channel.message_encoding == "cdr"
            assert channel.metadata["topic_type_hash"].startswith("RIHS01_")
            assert message.log_time == message.publish_time
            by_topic.setdefault(channel.topic, []).append(decoded)
    assert {topic: len(messages) for topic, messages in by_topic.items()} == {
        "/cycle": 10,
        "/joint_commands": 10,
        "/joint_states": 5,
        "/diagnostics": 1,
        "/bus/main": 1,
        "/bus/second": 1,
        "/events": len(by_topic["/events"]),
        "/rosout": len(by_topic["/events"]),
    }
    assert sum(len(messages) for messages in by_topic.values()) == summary.messages
    state = by_topic["/joint_states"][1]  # cycle 2
    assert list(state.name) == list(header.joints[1:])
    assert list(state.position) == [2.2, 2.3]
    assert bytes(by_topic["/bus/main"][0].data) == PACKETS[0].data + PACKETS[1].data


def test_states_that_are_not_valid_are_not_a_number(
    log: LogWriter, tmp_path: Path, header: LogHeader, cycle: Cycle, typestore: Typestore
) -> None:
    fill(log, cycle)
    with (tmp_path / "run.mcap").open("rb") as stream:
        for _, _, message in make_reader(stream).iter_messages("/joint_states"):
            state: Any = typestore.deserialize_cdr(message.data, "sensor_msgs/msg/JointState")
            number = (message.log_time - header.epoch_offset_ns - 1_005_000_000) // header.period_ns
            for values in (state.position, state.velocity, state.effort):
                assert list(np.isnan(values)) == [number % 3 == 0, False]


def test_two_writers_of_the_same_records_write_the_same_bytes(
    tmp_path: Path, header: LogHeader, cycle: Cycle
) -> None:
    for name in ("a", "b"):
        fill(LogWriter(tmp_path / name, header), cycle)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_gap_is_an_event_and_counted(log: LogWriter, tmp_path: Path, cycle: Cycle) -> None:
    log.write_record(RecordKind.CYCLE, cycle(0))
    log.gap("loop/packets", 17)
    assert log.close().gaps == 17
    (event,) = read_log(tmp_path / "run.mcap").events
    assert (event.code, event.severity) == (EventCode.RECORDER_GAP, Severity.ERROR)
    assert "17 records of loop/packets" in event.text
    assert read_log(tmp_path / "run.mcap").metadata["dxlrun_summary"]["gaps"] == "17"


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "the file is empty"),
        (b"name: torso\n", "not an MCAP file"),
        (b"\x89MCAP0\r\n", "is not a log of dxlrun"),
    ],
)
def test_what_is_no_log_is_refused_with_a_sentence(tmp_path: Path, content: bytes, sentence: str) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match=sentence):
        read_log(path)


def test_a_missing_log_and_a_directory_are_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="No such file"):
        read_log(tmp_path / "none.mcap")
    with pytest.raises(LogError, match="the directory has no log"):
        read_log(tmp_path)


def test_metadata_of_format_8_are_read(header: LogHeader) -> None:
    text = to_metadata(header)
    assert text["format"] == "9"
    assert from_metadata(text | {"format": "8"}) == from_metadata(text)


def test_metadata_without_units_of_sources_are_read(header: LogHeader) -> None:
    text = to_metadata(structs.replace(header, source_units={"imu/voltage": "V"}))
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
def test_a_log_of_another_format_or_with_wrong_metadata_is_refused(
    tmp_path: Path,
    header: LogHeader,
    monkeypatch: pytest.MonkeyPatch,
    wrong: dict[str, str | None],
    sentence: str,
) -> None:
    text = to_metadata(header) | wrong
    written = {name: value for name, value in text.items() if value is not None}
    monkeypatch.setattr("dxlrun.log.log_writer.to_metadata", lambda header: written)
    LogWriter(tmp_path / "x", header).close()
    with pytest.raises(LogError, match=sentence):
        read_log(tmp_path / "x")


Rewritten = Callable[[Callable[[Chunk], object]], Path]


@pytest.fixture
def rewritten(log: LogWriter, tmp_path: Path, cycle: Cycle) -> Rewritten:
    """Write a log of four chunks, the third of which is changed by hand."""

    def rewritten(change: Callable[[Chunk], object]) -> Path:
        path, chunks = tmp_path / "run.mcap", []
        for number in range(4):
            log.write_record(RecordKind.CYCLE, cycle(number))
            log.finish_chunk()
        log.close()
        with path.open("rb") as stream:
            records = [*StreamReader(stream, emit_chunks=True).records]
        with path.open("wb") as stream:
            stream.write(b"\x89MCAP0\r\n")
            for record in records:
                if isinstance(record, Chunk):
                    chunks.append(record)
                    if len(chunks) == 3:
                        change(record)
                builder = RecordBuilder()
                record.write(builder)
                stream.write(builder.end())
            stream.write(b"\x89MCAP0\r\n")
        return path

    return rewritten


@pytest.mark.parametrize(
    ("change", "why"),
    [
        *(
            (
                {"uncompressed_size": size},
                f"it is {size} bytes long when decompressed, and 67108864 are read at most",
            )
            for size in (1 << 40, 2**64 - 1)
        ),
        ({"compression": "rar"}, "its compression 'rar' is not known"),
    ],
    ids=str,
)
def test_a_chunk_that_cannot_be_read_is_left_out(
    rewritten: Rewritten, change: dict[str, object], why: str
) -> None:
    log = read_log(rewritten(lambda chunk: [setattr(chunk, *each) for each in change.items()]))

    assert log.cycles["cycle"].tolist() == [0, 1, 3]
    assert log.damage == (f"a chunk of messages is damaged and skipped: {why}",)


@pytest.mark.parametrize("compress", [zstandard.compress, lz4.frame.compress])
def test_a_chunk_that_is_longer_than_its_header_has_it_is_not_decompressed_further(
    rewritten: Rewritten, compress: Callable[[bytes], bytes]
) -> None:
    def change(chunk: Chunk) -> None:
        chunk.data, chunk.uncompressed_crc = compress(bytes(40 << 20)), 0
        chunk.compression = "lz4" if compress is lz4.frame.compress else "zstd"

    path = rewritten(change)
    tracemalloc.start()
    try:
        log = read_log(path)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()

    assert log.cycles["cycle"].tolist() == [0, 1, 3]
    assert log.damage == ("a chunk of messages is damaged and skipped: it has the wrong length",)
    assert most < 10 << 20


def test_a_file_becomes_only_so_many_times_as_long(
    rewritten: Rewritten, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chunks, "_LARGEST", 2 << 20)
    monkeypatch.setattr(chunks, "_MOST_EXPANDED", 0)

    def change(chunk: Chunk) -> None:
        chunk.data, chunk.uncompressed_size = zstandard.compress(bytes(2 << 20)), 2 << 20
        chunk.uncompressed_crc = 0

    assert "becomes more than 0 times as long when decompressed" in read_log(rewritten(change)).damage[0]


def test_a_long_attachment_is_compressed_and_comes_back(tmp_path: Path, header: LogHeader) -> None:
    plan, path = json.dumps(list(range(20_000))).encode(), tmp_path / "run.mcap"
    LogWriter(path, structs.replace(header, attachments={"plan.json": plan, "robot.yaml": b"r"})).close()
    with path.open("rb") as stream:
        attached = {one.name: (one.media_type, one.data) for one in make_reader(stream).iter_attachments()}
    assert set(attached) == {"plan.json.zst", "robot.yaml", "header.json"}
    media, data = attached["plan.json.zst"]
    assert (media, zstandard.decompress(data)) == ("application/zstd", plan)
    assert read_log(path).attachments["plan.json"] == plan


@pytest.mark.parametrize("wrong", ["too long", "cut", "no zstd"])
def test_a_compressed_attachment_that_is_wrong_is_left_out(
    tmp_path: Path, header: LogHeader, wrong: str
) -> None:
    whole = zstandard.compress(bytes(range(256)) * 2000)
    data = {"too long": zstandard.compress(bytes(65 << 20)), "cut": whole[:-20], "no zstd": b"no zstd"}[wrong]
    with (tmp_path / "run.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start(schemas.PROFILE)
        writer.add_metadata(schemas.METADATA_NAME, to_metadata(header))
        writer.add_attachment(0, 0, "plan.json.zst", "application/zstd", data)
        writer.finish()
    read = read_log(tmp_path / "run.mcap")
    assert "plan.json" not in read.attachments
    assert "a record of kind attachment cannot be read" in read.damage[0]


@pytest.mark.parametrize("compression", ["lz4", ""])
def test_a_log_that_another_tool_compressed_anew_is_read(rewritten: Rewritten, compression: str) -> None:
    def change(chunk: Chunk) -> None:
        data = zstandard.decompress(chunk.data)
        chunk.data = lz4.frame.compress(data) if compression else data
        chunk.compression = compression

    log = read_log(rewritten(change))

    assert (log.cycles["cycle"].tolist(), log.complete) == ([0, 1, 2, 3], True)


def test_a_mode_that_is_none_is_reported(
    log: LogWriter, tmp_path: Path, cycle: Cycle, layout: CycleLayout
) -> None:
    record = np.frombuffer(bytearray(cycle(7)), dtype=layout.dtype)
    record["mode"][0, 1] = 77
    log.write_record(RecordKind.CYCLE, record.tobytes())
    log.close()
    with pytest.raises(LogError, match="cycle 7 has an unknown mode of a servo"):
        read_log(tmp_path / "run.mcap")


def test_a_log_is_never_overwritten(log: LogWriter, tmp_path: Path, header: LogHeader) -> None:
    log.close()
    before = (tmp_path / "run.mcap").read_bytes()
    with pytest.raises(FileExistsError):
        LogWriter(tmp_path / "run.mcap", header)
    assert (tmp_path / "run.mcap").read_bytes() == before


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_stops_the_writing_and_leaves_a_readable_log(
    log: LogWriter, tmp_path: Path, cycle: Cycle
) -> None:
    path = tmp_path / "run.mcap"
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
    assert len(read.cycles) == 1
    assert not read.complete


def test_a_disk_that_is_full_at_the_end_is_reported(log: LogWriter, tmp_path: Path, cycle: Cycle) -> None:
    log.write_record(RecordKind.CYCLE, cycle(0))
    with files_of_at_most((tmp_path / "run.mcap").stat().st_size):
        summary = log.close()
    assert summary.error is not None
    assert summary.messages == 0


@pytest.mark.parametrize("what", ["deleted", "moved", "replaced"])
def test_a_file_that_is_gone_is_reported(log: LogWriter, tmp_path: Path, cycle: Cycle, what: str) -> None:
    path, elsewhere = tmp_path / "run.mcap", tmp_path / "elsewhere.mcap"
    log.write_record(RecordKind.CYCLE, cycle(0))
    log.finish_chunk()
    path.rename(elsewhere)
    if what == "deleted":
        elsewhere.unlink()
    if what == "replaced":
        path.write_bytes(b"another")
    assert log.close().error == "another program deleted or moved the file during the run"


def test_a_file_that_was_cut_is_reported_and_gets_no_hole(
    log: LogWriter, tmp_path: Path, cycle: Cycle
) -> None:
    path = tmp_path / "run.mcap"
    log.write_record(RecordKind.CYCLE, cycle(0))
    log.finish_chunk()
    os.truncate(path, 100)
    log.write_record(RecordKind.CYCLE, cycle(1))
    assert log.close().error == "writing the log stopped: another program truncated the file"
    assert path.stat().st_size == 100


# The URDF


def test_the_urdf_comes_first_and_once(header: LogHeader, cycle: Cycle, tmp_path: Path) -> None:
    path = tmp_path / "described.mcap"
    writer = LogWriter(path, structs.replace(header, robot_description="<robot name='körper'/>"))
    for number in range(3):
        writer.write_record(RecordKind.CYCLE, cycle(number))
    summary = writer.close()
    with path.open("rb") as stream:
        reader: Any = make_reader(stream, decoder_factories=[DecoderFactory()])
        read = [(c, m, decoded) for _, c, m, decoded in reader.iter_decoded_messages(log_time_order=False)]
    channel, message, decoded = read[0]
    assert (channel.topic, decoded.data) == ("/robot_description", "<robot name='körper'/>")
    assert message.log_time == read[1][1].log_time  # the run begins with its first record
    assert [each[0].topic for each in read].count("/robot_description") == 1
    assert len(read) == summary.messages
    (profile,) = yaml.safe_load(channel.metadata["offered_qos_profiles"])
    assert (profile["durability"], profile["reliability"], profile["history"]) == (1, 1, 1)
    assert profile["deadline"] == {"sec": 9223372036, "nsec": 854775807}
    assert channel.metadata["topic_type_hash"] == schemas.STRING.type_hash
