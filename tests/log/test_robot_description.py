"""/robot_description: one message at the start, kept for who comes later."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from msgspec.structs import replace

from dxlrun.channels.ring import RecordKind
from dxlrun.log import schemas
from dxlrun.log.log_writer import LogWriter
from dxlrun.log.schemas import LogHeader

TOPIC = "/robot_description"


def test_the_urdf_comes_first_and_once(
    header: LogHeader, cycle: Callable[[int], bytes], tmp_path: Path
) -> None:
    path = tmp_path / "described.mcap"
    writer = LogWriter(path, replace(header, robot_description="<robot name='körper'/>"))
    for number in range(3):
        writer.take(RecordKind.CYCLE, cycle(number))
    summary = writer.close()
    with path.open("rb") as stream:
        reader: Any = make_reader(stream, decoder_factories=[DecoderFactory()])
        read = [(c, m, decoded) for _, c, m, decoded in reader.iter_decoded_messages(log_time_order=False)]
    channel, message, decoded = read[0]
    assert (channel.topic, decoded.data) == (TOPIC, "<robot name='körper'/>")
    assert message.log_time == read[1][1].log_time  # the run begins with its first record
    assert [each[0].topic for each in read].count(TOPIC) == 1
    assert len(read) == summary.messages
    (profile,) = yaml.safe_load(channel.metadata["offered_qos_profiles"])
    assert (profile["durability"], profile["reliability"], profile["history"]) == (1, 1, 1)
    assert profile["deadline"] == {"sec": 9223372036, "nsec": 854775807}
    assert channel.metadata["topic_type_hash"] == schemas.STRING.type_hash


def test_a_robot_without_a_urdf_has_no_such_topic(
    header: LogHeader, cycle: Callable[[int], bytes], tmp_path: Path
) -> None:
    writer = LogWriter(tmp_path / "plain.mcap", header)
    writer.take(RecordKind.CYCLE, cycle(0))
    writer.close()
    with (tmp_path / "plain.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert TOPIC not in {channel.topic for channel in summary.channels.values()}
