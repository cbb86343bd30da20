"""Recovering a log: whatever can be read is in the new file, and what cannot is declared."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from textwrap import dedent

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys.store import Typestore

from dxlrun.channels.ring import RecordKind
from dxlrun.cli import main
from dxlrun.errors import LogError
from dxlrun.log.log_writer import LogFile, LogWriter
from dxlrun.log.reader import read_log
from dxlrun.log.schemas import LogHeader
from dxlrun.plan.recording_plan import RECOVERED_NAME
from dxlrun_analysis.export.recover import recover_file, recover_log

Message = tuple[str, int, int, bytes]
"""Topic, sequence, time, content."""


def messages(path: Path) -> list[Message]:
    """Return the messages of a whole file as the library reads them, by its index."""
    with path.open("rb") as stream:
        found = make_reader(stream, validate_crcs=True).iter_messages()
        return [(channel.topic, one.sequence, one.log_time, one.data) for _, channel, one in found]


@pytest.fixture
def log(tmp_path: Path, header: LogHeader, cycle: Callable[[int], bytes]) -> Path:
    """Two hundred cycles in chunks of twenty."""
    writer = LogWriter(tmp_path / "run.mcap", header)
    for number in range(200):
        writer.take(RecordKind.CYCLE, cycle(number))
        if number % 20 == 19:
            writer.flush()
    writer.close()
    return tmp_path / "run.mcap"


def cut(log: Path, size: int) -> Path:
    """Return the file's first bytes as a file of its own."""
    path = log.with_name("cut.mcap")
    path.write_bytes(log.read_bytes()[:size])
    return path


def test_a_whole_log_is_copied_whole(log: Path, tmp_path: Path) -> None:
    result = recover_file(log, tmp_path / "new.mcap")
    assert result.whole
    assert messages(tmp_path / "new.mcap") == messages(log)
    new, old = read_log(tmp_path / "new.mcap"), read_log(log)
    assert (new.complete, new.attachments, new.header) == (True, old.attachments, old.header)


def test_a_log_without_an_end_gets_an_index_and_says_what_it_lacks(log: Path, tmp_path: Path) -> None:
    size = log.stat().st_size
    result = recover_file(cut(log, size * 6 // 10), tmp_path / "new.mcap")

    read, before = messages(tmp_path / "new.mcap"), messages(log)
    assert read == before[: len(read)]
    assert 0 < len(read) < len(before)
    assert (result.messages, result.end) == (len(read), False)
    record = read_log(tmp_path / "new.mcap").metadata[RECOVERED_NAME]
    assert (record["from"], record["messages"], record["end"]) == ("cut.mcap", str(len(read)), "missing")
    damage = read_log(tmp_path / "new.mcap").damage
    assert damage[-1] == "recovered from cut.mcap: it has no end: what was written last is lost with it"


def test_truncation_anywhere_gives_the_messages_before_it_and_declares_the_rest(
    log: Path, tmp_path: Path
) -> None:
    """At a sample of its bytes, or at every one: by the campaign's variable."""
    whole, size = messages(log), log.stat().st_size
    step = max(1, size // int(os.environ.get("DXLRUN_TRUNCATIONS", "40")))
    most, kept = 0, 0
    for at in range(1, size, step):
        new = tmp_path / "new.mcap"
        new.unlink(missing_ok=True)
        try:
            result = recover_file(cut(log, at), new)
        except LogError:  # the cut lies before the first whole chunk
            assert most == 0
            continue
        read = messages(new)
        assert read == whole[: len(read)]
        assert (result.messages, result.end) == (len(read), False)
        assert result.sentences
        assert len(read) >= most
        most, kept = len(read), kept + 1
    assert kept > 5
    assert most == len(whole)


def test_a_damaged_chunk_is_left_out_and_its_messages_counted(log: Path, tmp_path: Path) -> None:
    data = bytearray(log.read_bytes())
    places = [at for at in range(len(data)) if data.startswith(b"\x04\x00\x00\x00zstd", at)]
    data[places[4] + 40] ^= 0xFF
    log.write_bytes(data)

    result = recover_file(log, tmp_path / "new.mcap")

    assert result.end
    assert result.lost_messages > 20
    assert len(result.sentences) == 1
    assert "is damaged and left out" in result.sentences[0]
    cycles = read_log(tmp_path / "new.mcap").cycles["cycle"].tolist()
    assert cycles == [*range(80), *range(100, 200)]


def test_channels_that_a_damaged_chunk_defined_come_from_the_index(log: Path, tmp_path: Path) -> None:
    whole = len(messages(log))
    data = bytearray(log.read_bytes())
    data[data.find(b"\x04\x00\x00\x00zstd") + 40] ^= 0xFF
    log.write_bytes(data)
    result = recover_file(log, tmp_path / "new.mcap")
    assert result.messages + result.lost_messages == whole
    assert read_log(tmp_path / "new.mcap").cycles["cycle"].tolist() == [*range(20, 200)]


def test_behind_a_length_that_is_wrong_the_next_chunk_is_found(log: Path, tmp_path: Path) -> None:
    whole = len(messages(log))
    data = bytearray(log.read_bytes())
    places = [at for at in range(len(data)) if data.startswith(b"\x04\x00\x00\x00zstd", at)]
    data[places[3] - 37 + 1 : places[3] - 37 + 9] = b"\xff" * 8
    log.write_bytes(data)
    result = recover_file(log, tmp_path / "new.mcap")
    cycles = read_log(tmp_path / "new.mcap").cycles["cycle"].tolist()
    assert cycles == [*range(60), *range(80, 200)]
    assert result.messages + result.lost_messages == whole
    assert "cannot be read and are left out" in result.sentences[0]


FLIPS = int(os.environ.get("DXLRUN_RECOVER_FLIPS", "60"))


@pytest.mark.campaign
def test_flipped_bits_never_end_in_more_than_a_sentence(log: Path, tmp_path: Path) -> None:
    rng = random.Random(int(os.environ.get("DXLRUN_RECOVER_SEED", "15")))
    whole, before = log.read_bytes(), set(messages(log))
    for _ in range(FLIPS):
        data = bytearray(whole)
        for _ in range(rng.choice([1, 1, 4, 30])):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        log.write_bytes(data)
        new = tmp_path / "new.mcap"
        new.unlink(missing_ok=True)
        try:
            result = recover_file(log, new)
        except LogError:
            continue
        read = messages(new)
        assert result.messages == len(read)
        # what lies outside of chunks has no checksum; a message of this writer always lies in one
        topics = {topic for topic, *_ in before}
        if not any("is cut" in sentence for sentence in result.sentences):
            assert {one for one in read if one[0] in topics} <= before


def test_an_index_that_a_flipped_bit_makes_a_message_is_left_out(log: Path, tmp_path: Path) -> None:
    data, at, before = bytearray(log.read_bytes()), 8, messages(log)
    while data[at] != Opcode.MESSAGE_INDEX:
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    data[at] = Opcode.MESSAGE
    log.write_bytes(data)
    result = recover_file(log, tmp_path / "new.mcap")
    assert f"a message at byte {at} is in no chunk, as all others are: left out" in result.sentences
    assert messages(tmp_path / "new.mcap") == before


@pytest.mark.parametrize("content", [b"", b"no MCAP file at all", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n\x01\xff"])
def test_what_has_nothing_is_refused_with_one_sentence(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(LogError, match=r"x\.mcap: "):
        recover_file(tmp_path / "x.mcap", tmp_path / "new.mcap")


def test_a_foreign_file_is_recovered_too(tmp_path: Path) -> None:
    with (tmp_path / "f.mcap").open("wb") as stream:
        writer = Writer(stream, chunk_size=1000)
        writer.start(profile="mine")
        schema = writer.register_schema("S", "jsonschema", b"{}")
        channel = writer.register_channel("/a", "json", schema)
        for number in range(200):
            writer.add_message(channel, number, b'{"a": 1}' * 5, number)
        writer.finish()
    whole = messages(tmp_path / "f.mcap")
    result = recover_file(cut(tmp_path / "f.mcap", 3000), tmp_path / "new.mcap")
    read = messages(tmp_path / "new.mcap")
    assert read == whole[: len(read)]
    assert len(read) == result.messages > 50
    with (tmp_path / "new.mcap").open("rb") as stream:
        assert make_reader(stream).get_header().profile == "mine"


def test_the_parts_of_a_log_are_recovered_each(tmp_path: Path, header: LogHeader, log: Path) -> None:
    (tmp_path / "run").mkdir()
    for part in (0, 1, 3):
        shutil.copy(log, tmp_path / f"run/part_000{part}.mcap")
    (tmp_path / "run/part_0001.mcap").write_bytes(log.read_bytes()[:-5000])
    (tmp_path / "run/part_0003.mcap").write_bytes(b"")
    result = recover_log(tmp_path / "run", tmp_path / "new")
    assert [one.whole for one in result.files.values()] == [True, False]
    assert result.missing[0] == "part_0002.mcap is missing"
    assert "part_0003.mcap: the file is empty" in result.missing[1]
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["part_0000.mcap", "part_0001.mcap"]


def test_other_readers_open_a_recovered_file(log: Path, tmp_path: Path, typestore: Typestore) -> None:
    recover_file(cut(log, log.stat().st_size // 2), tmp_path / "new.mcap")
    with (tmp_path / "new.mcap").open("rb") as stream:
        decoded = sum(
            1 for _ in make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        )
    with AnyReader([tmp_path / "new.mcap"], default_typestore=typestore) as bag:
        assert bag.message_count == decoded == len(messages(tmp_path / "new.mcap"))


def test_the_command_writes_beside_and_never_over(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = cut(log, log.stat().st_size // 2)
    assert main(["recover", str(broken)]) == 0
    text = capsys.readouterr().out
    assert "messages recovered" in text
    assert "has no end" in text
    assert read_log(tmp_path / "cut_recovered.mcap").cycles.size
    size = broken.stat().st_size
    assert main(["recover", str(broken)]) == 2
    assert "nothing is written over" in capsys.readouterr().err
    assert broken.stat().st_size == size


def test_a_full_disk_leaves_nothing_behind(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(self: LogFile, data: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(LogFile, "write", full)
    assert main(["recover", str(log), str(tmp_path / "new.mcap")]) == 2
    assert "No space left on device" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.mcap"]


WRITER = """
    import sys, time
    from pathlib import Path
    from dxlrun.log.part_writer import open_writer
    from dxlrun.plan.recording_plan import RecordingPlan
    from dxlrun.log.schemas import LogHeader
    from dxlrun.channels.cycle import CycleLayout, CycleRecord
    from dxlrun.channels.ring import RecordKind

    split = int(sys.argv[2]) or None
    header = LogHeader("r", ("a", "b"), ("main",), (), 10**6, 0)
    log = open_writer(Path(sys.argv[1]), header, RecordingPlan(split_ns=split))
    record = CycleRecord(CycleLayout(header.joints, ()))
    for number in range(1_000_000):
        record.cycle = number
        record.scheduled_ns = record.woken_ns = record.written_ns = number * 10**6
        print(number, flush=True)  # from here on it is handed to the recorder
        log.take(RecordKind.CYCLE, bytes(record.raw))
        if number % 50 == 49:
            log.flush()
            print("flushed", number, flush=True)
            if split:
                log.settle()
"""
KILLS = int(os.environ.get("DXLRUN_RECORDER_KILLS", "3"))


@pytest.mark.campaign
@pytest.mark.parametrize("split_ns", [0, 300_000_000], ids=["one file", "parts"])
def test_after_kill_9_all_that_was_flushed_is_recovered(tmp_path: Path, split_ns: int) -> None:
    rng = random.Random(int(os.environ.get("DXLRUN_RECORDER_SEED", "15")) + split_ns)
    for number in range(KILLS):
        path = tmp_path / f"{number}.mcap"
        command = [sys.executable, "-c", dedent(WRITER), str(path), str(split_ns)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
            assert child.stdout is not None
            lines: list[str] = []
            for line in child.stdout:
                lines.append(line)
                if len(lines) > rng.randrange(100, 1500):
                    break
            child.send_signal(signal.SIGKILL)
            lines += child.stdout.readlines()
        handed = sum(line.strip().isdigit() for line in lines)
        flushed = max((int(line.split()[1]) + 1 for line in lines if line.startswith("flushed")), default=0)
        if not flushed:
            continue
        new = tmp_path / f"new{number}.mcap"
        result = recover_log(path, new)
        cycles = read_log(new).cycles["cycle"].tolist()
        assert cycles == list(range(len(cycles)))
        assert flushed <= len(cycles) <= handed
        assert not result.whole
        assert not read_log(new).complete
