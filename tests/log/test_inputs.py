"""The log's inputs: what controllers were activated with, and the commands they took."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from msgspec import structs

from dxlrun.channels.commands import CommandRing, TakenCommand
from dxlrun.channels.ring import Handover, RecordKind
from dxlrun.log.log_reader import read_log
from dxlrun.log.log_writer import LogWriter

PLANNED = TakenCommand(5_000, 3, 7, "left_arm", "trajectory", "wave.yaml:7:5", b"")
GIVEN = TakenCommand(6_000, 4, -1, "head", "positions", "anna", np.array([0.5, -0.0, np.nan]).tobytes())
STREAMED = TakenCommand(
    6_500, 4, -1, "head", "positions", "anna", np.array([0.25]).tobytes(), lease_ns=200_000_000
)
STEERING = TakenCommand(6_600, 4, -1, "", "switch", "anna", b'{"activate":["head"],"deactivate":[]}')
LONG = TakenCommand(6_700, 4, -1, "", "load", "anna", b'{"name":"' + b"n" * 2000 + b'"}')
NO_NUMBERS = TakenCommand(6_800, 4, -1, "head", "positions", "mallory", b"thirteen byte")
TAKEN = (PLANNED, GIVEN, STREAMED, STEERING, LONG, NO_NUMBERS)


@pytest.fixture
def written(log: LogWriter, tmp_path: Path, cycle: Callable[[int], bytes]) -> Path:
    log.write_record(RecordKind.CYCLE, cycle(-1))
    ring = CommandRing(Handover(log.write_record))
    for number in range(5):
        for command in TAKEN:
            if command.cycle == number:
                ring.record_command(command)
        log.write_record(RecordKind.CYCLE, cycle(number))
    log.close()
    return tmp_path / "run.mcap"


def test_they_come_back_as_they_were(written: Path, cycle: Callable[[int], bytes]) -> None:
    log = read_log(written)
    assert log.commands == TAKEN
    assert log.complete
    assert log.activation is not None
    assert log.activation.tobytes() == cycle(-1)
    assert log.cycles["cycle"].tolist() == [0, 1, 2, 3, 4]


def test_another_reader_decodes_them(written: Path) -> None:
    found: dict[str, list[Any]] = {}
    with written.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(["/activation", "/commands"]):
            found.setdefault(channel.topic, []).append(message)
    assert [message.cycle for message in found["/activation"]] == [-1]
    planned, given, streamed, steering, *_ = found["/commands"]
    assert (planned.cycle, planned.planned, planned.controller, list(planned.data)) == (3, 7, "left_arm", [])
    assert (given.planned, given.kind, given.origin) == (-1, "positions", "anna")
    assert np.array(given.data).tobytes() == GIVEN.data
    assert (streamed.lease_ns, list(streamed.data), streamed.text) == (200_000_000, [0.25], "")
    assert (steering.controller, steering.kind, list(steering.data)) == ("", "switch", [])
    assert steering.text == STEERING.data.decode()


def test_what_was_no_json_is_none_in_the_log(log: LogWriter, tmp_path: Path) -> None:
    for data in (b'{"a": "\xff"}', b"\xfe", b""):
        CommandRing(Handover(log.write_record)).record_command(structs.replace(STEERING, data=data))
    log.close()
    read = read_log(tmp_path / "run.mcap")
    first, second, third = (command.data for command in read.commands)
    for data in (first, second, third):
        with pytest.raises(ValueError, match=r"Expecting|Invalid"):
            json.loads(data)
    assert read.complete


def test_a_log_without_them_has_none(log: LogWriter, tmp_path: Path, cycle: Callable[[int], bytes]) -> None:
    log.write_record(RecordKind.CYCLE, cycle(0))
    log.close()
    read = read_log(tmp_path / "run.mcap")
    assert (read.activation, read.commands) == (None, ())
