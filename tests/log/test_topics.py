"""Topics of controllers in the log: other programs decode them without a line of ours."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from dxlrun import Floats, LogError
from dxlrun.channels.ring import Handover, RecordKind
from dxlrun.channels.topic_messages import MessageRing, PublishedTopic
from dxlrun.log.log_reader import open_log, read_log
from dxlrun.log.log_writer import LogWriter
from dxlrun.messages import Header, Odometry
from dxlrun.messages.declared import declared_message
from dxlrun_analysis.report import analyze_log, tables

PERIOD_NS = 20_000_000


@dataclass
class WaveState:
    header: Header
    time_s: float
    error: Floats
    names: tuple[str, ...]


def moved(x: float) -> Odometry:
    odometry = Odometry(child_frame_id="base")
    odometry.pose.pose.position.x = x
    odometry.pose.covariance[35] = 0.5
    return odometry


@pytest.fixture
def path(log: LogWriter, tmp_path: Path, cycle: Callable[[int], bytes]) -> Path:
    """50 cycles with messages of two topics, one in every fifth; the first one has nothing in its arrays."""
    ring, offset_ns = MessageRing(Handover(log.write_record)), log.header.epoch_offset_ns
    kinds = {"state": declared_message(WaveState, "my_robotics"), "odometry": declared_message(Odometry, "")}
    numbers = {
        name: ring.announce(PublishedTopic(f"/wave/{name}", kind.type)) for name, kind in kinds.items()
    }

    def publish(name: str, t_ns: int, message: object) -> None:
        stamp = divmod(t_ns + offset_ns, 10**9)
        ring.message(numbers[name], t_ns, kinds[name].pack(message, stamp))

    publish("state", 10**9 - 1, WaveState(Header(frame_id="begin"), 0.0, np.zeros(0), ()))
    for number in range(50):
        t_ns, time_s = 10**9 + 60_000 + number * PERIOD_NS, number * 0.02
        log.write_record(RecordKind.CYCLE, cycle(number))
        publish("state", t_ns, WaveState(Header(), time_s, np.array([time_s, np.nan]), ("pan", "tilt")))
        if number % 5 == 0:
            publish("odometry", t_ns, moved(time_s))
    log.close()
    return tmp_path / "run.mcap"


def test_mcap_ros2_decodes_every_message(path: Path) -> None:
    of: dict[str, list[Any]] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        topics = ["/wave/state", "/wave/odometry"]
        for schema, channel, message, decoded in reader.iter_decoded_messages(topics=topics):
            assert schema is not None
            of.setdefault(f"{channel.topic} {schema.name}", []).append(decoded)
            assert message.log_time == decoded.header.stamp.sec * 10**9 + decoded.header.stamp.nanosec
    states, odometry = of["/wave/state my_robotics/msg/WaveState"], of["/wave/odometry nav_msgs/msg/Odometry"]
    assert (len(states), len(odometry)) == (51, 10)
    assert (states[0].header.frame_id, list(states[0].error), states[0].names) == ("begin", [], [])
    assert states[2].time_s == states[2].error[0] == pytest.approx(0.02)
    assert np.isnan(states[2].error[1])
    assert states[2].names == ["pan", "tilt"]
    assert odometry[-1].pose.pose.position.x == pytest.approx(0.9)
    assert odometry[-1].pose.covariance[35] == 0.5


def test_our_reader_has_messages_times_and_columns(path: Path) -> None:
    read = read_log(path)
    states = read.messages("/wave/state")
    assert states[0]["names"] == []
    assert states[2]["names"] == ["pan", "tilt"]
    topic = read.topics["/wave/odometry"]
    assert (topic.type.name, len(topic.data)) == ("nav_msgs/msg/Odometry", 10)
    np.testing.assert_allclose(topic.column("pose.pose.position.x"), np.arange(10) * 0.1, atol=1e-9)
    assert topic.column("pose.covariance").shape == (10, 36)
    assert topic.t_ns.tolist() == read.cycles["woken_ns"][::5].tolist()


@pytest.mark.parametrize(
    ("topic", "field", "reason"),
    [
        ("/wave/state", "header.stamp.year", "messages of /wave/state have no field header.stamp.year"),
        ("/wave/state", "error", "error of /wave/state is not always of the same length"),
        ("/wave/states", "", "no topic /wave/states; did you mean /wave/state?"),
    ],
)
def test_what_a_log_does_not_have_is_one_sentence(path: Path, topic: str, field: str, reason: str) -> None:
    read = read_log(path)
    with pytest.raises(LogError, match=re.escape(reason)):
        read.topics[topic].column(field) if field else read.messages(topic)


def test_messages_are_counted_by_the_report_and_come_in_slices(path: Path) -> None:
    rows = tables(analyze_log(path))["topics"].rows
    assert [tuple(cell.text for cell in row[:3]) for row in rows] == [
        ("/wave/state", "my_robotics/msg/WaveState", "51"),
        ("/wave/odometry", "nav_msgs/msg/Odometry", "10"),
    ]
    reader = open_log(path)
    found = [(name, len(topic.data)) for part in reader.slices() for name, topic in part.topics.items()]
    assert {name for name, _ in found} == {"/wave/state", "/wave/odometry"}
    assert sum(count for _, count in found) == 61
    assert reader.about.topics["/wave/state"].data == ()
