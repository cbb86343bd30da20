"""The log's inputs: what controllers were activated with, and the commands they took."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from dxlrun.commands import CommandRing, TakenCommand
from dxlrun.recording.log_writer import LogWriter
from dxlrun.recording.reader import read_log
from dxlrun.ring import Handover

PLANNED = TakenCommand(5_000, 3, 7, "left_arm", "trajectory", "wave.yaml:7:5", b"")
GIVEN = TakenCommand(6_000, 4, -1, "head", "positions", "somebody", np.array([0.5, -0.0, np.nan]).tobytes())


@pytest.fixture
def written(log: LogWriter, tmp_path: Path, cycle: Callable[[int], bytes]) -> Path:
    log.cycle(cycle(-1))
    ring = CommandRing(Handover(log.command))
    for number in range(5):
        for command in (PLANNED, GIVEN):
            if command.cycle == number:
                ring.take(command)
        log.cycle(cycle(number))
    log.close()
    return tmp_path / "run.mcap"


def test_they_come_back_as_they_were(written: Path, cycle: Callable[[int], bytes]) -> None:
    log = read_log(written)
    assert log.commands == (PLANNED, GIVEN)
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
    planned, given = found["/commands"]
    assert (planned.cycle, planned.planned, planned.controller, list(planned.data)) == (3, 7, "left_arm", [])
    assert (given.planned, given.kind, given.origin) == (-1, "positions", "somebody")
    assert np.array(given.data).tobytes() == GIVEN.data


def test_a_log_without_them_says_so(log: LogWriter, tmp_path: Path, cycle: Callable[[int], bytes]) -> None:
    log.cycle(cycle(0))
    log.close()
    read = read_log(tmp_path / "run.mcap")
    assert (read.activation, read.commands) == (None, ())
