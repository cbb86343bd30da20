"""Topics of controllers in the log: other programs decode them without a line of ours."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from tests.kit.stories import plugin_folder

from dxlrun import LogError
from dxlrun.log.reader import open_log, read_log
from dxlrun.testing import simulated_robot
from dxlrun_analysis.report import analyze_log, tables

ROBOT = """\
name: pair
buses:
  main:
    port: sim
    protocol: 1.0
    baud_rate: 1_000_000
    return_delay_time: 100 us
    adapter: {latency: 1 ms}
loop: {rate: 50}
joints:
  pan: {bus: main, id: 3, model: AX-12A, reference: 150 deg, direction: 1}
  tilt: {bus: main, id: 7, model: AX-12A, reference: 150 deg, direction: 1}
controllers:
  wave: {type: publishing, joints: [pan, tilt]}
  slow: {type: publishing, joints: [], rate: 10}
"""
PLUGIN = '''\
"""A controller with topics: one of its own message, one of ROS 2."""
from dataclasses import dataclass

import numpy as np
from dxlrun import CONTRACT_VERSION, Controller, Floats, Interfaces, ParametersModel, hookimpl
from dxlrun.messages import Header, Odometry


class PublishingParameters(ParametersModel):
    joints: tuple[str, ...]


@dataclass
class WaveState:
    header: Header
    time_s: float
    error: Floats
    names: tuple[str, ...]


class Publishing(Controller[PublishingParameters]):
    Parameters = PublishingParameters
    Topics = {"state": WaveState, "odometry": Odometry}

    @classmethod
    def interfaces(cls, parameters, joints):
        return Interfaces(parameters.joints, ("position",))

    def on_activate(self, time_ns):
        self.context.publish("state", WaveState(Header(frame_id="begin"), 0.0, np.zeros(0), ()))

    def update(self, time_ns, period_ns):
        names = self.context.joints
        error = np.full(len(names), np.nan)
        error[:1] = time_ns * 1e-9
        self.context.publish("state", WaveState(Header(), time_ns * 1e-9, error, names))
        odometry = Odometry(child_frame_id="base")
        odometry.pose.pose.position.x = time_ns * 1e-9
        odometry.pose.covariance[35] = 0.5
        self.context.publish("odometry", odometry)


@hookimpl
def dxlrun_contract():
    return CONTRACT_VERSION


@hookimpl
def dxlrun_controllers():
    return {"publishing": Publishing}
'''


@pytest.fixture(scope="module")
def plugin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return plugin_folder(tmp_path_factory.mktemp("plugin"), "publishing", PLUGIN, "my-robotics")


@pytest.fixture
def log(plugin: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A second of the robot."""
    monkeypatch.syspath_prepend(plugin)
    (tmp_path / "pair.yaml").write_text(ROBOT)
    robot = simulated_robot(tmp_path / "pair.yaml", duration_s=1.0, log=tmp_path / "run.mcap")
    assert robot.run().detail == ""
    return tmp_path / "run.mcap"


def test_mcap_ros2_decodes_every_message(log: Path) -> None:
    with log.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        found = [
            (channel.topic, schema.name, message.log_time, decoded)
            for schema, channel, message, decoded in reader.iter_decoded_messages(
                topics=["/wave/state", "/slow/state", "/wave/odometry"]
            )
            if schema is not None
        ]
    of: dict[str, list[Any]] = {}
    for topic, _, _, decoded in found:
        of.setdefault(topic, []).append(decoded)
    assert {topic: len(messages) for topic, messages in of.items()} == {
        "/wave/state": 51,
        "/slow/state": 11,
        "/wave/odometry": 50,
    }
    assert {name for _, name, _, _ in found} == {"my_robotics/msg/WaveState", "nav_msgs/msg/Odometry"}
    for _, _, log_ns, decoded in found:
        assert log_ns == decoded.header.stamp.sec * 10**9 + decoded.header.stamp.nanosec
    begin, first, second = of["/wave/state"][:3]
    assert (begin.header.frame_id, list(begin.error), begin.names) == ("begin", [], [])
    assert first.time_s == 0.0
    assert second.time_s == pytest.approx(0.02)
    assert second.names == ["pan", "tilt"]
    assert second.error[0] == second.time_s
    assert np.isnan(second.error[1])
    last = of["/wave/odometry"][-1]
    assert last.pose.pose.position.x == pytest.approx(0.98)
    assert last.pose.covariance[35] == 0.5


def test_our_reader_has_messages_times_and_columns(log: Path) -> None:
    read = read_log(log)
    assert {"/wave/state", "/wave/odometry", "/slow/state", "/slow/odometry"} <= set(read.topics)
    states = read.messages("/wave/state")
    assert states[0]["names"] == []
    assert states[2]["names"] == ["pan", "tilt"]
    topic = read.topics["/slow/odometry"]
    assert (topic.type.name, len(topic.data)) == ("nav_msgs/msg/Odometry", 10)
    np.testing.assert_allclose(topic.column("pose.pose.position.x"), np.arange(10) * 0.1, atol=1e-9)
    assert topic.column("pose.covariance").shape == (10, 36)
    woken = dict(zip(read.cycles["cycle"].tolist(), read.cycles["woken_ns"].tolist(), strict=True))
    assert topic.t_ns.tolist() == [woken[cycle] for cycle in range(0, 50, 5)]


@pytest.mark.parametrize(
    ("topic", "field", "reason"),
    [
        ("/wave/state", "header.stamp.year", "messages of /wave/state have no field header.stamp.year"),
        ("/wave/state", "error", "error of /wave/state is not always of the same length"),
        ("/wave/states", "", "no topic /wave/states; did you mean /wave/state?"),
    ],
)
def test_what_a_log_does_not_have_is_one_sentence(log: Path, topic: str, field: str, reason: str) -> None:
    read = read_log(log)
    with pytest.raises(LogError, match=re.escape(reason)):
        read.topics[topic].column(field) if field else read.messages(topic)


def test_the_report_counts_the_messages(log: Path) -> None:
    table = tables(analyze_log(log))["topics"]
    counted = {tuple(cell.text for cell in row[:3]) for row in table.rows}
    assert ("/wave/state", "my_robotics/msg/WaveState", "51") in counted
    assert ("/wave/odometry", "nav_msgs/msg/Odometry", "50") in counted


def test_a_log_is_read_slice_by_slice_with_its_topics(log: Path) -> None:
    counts: dict[str, int] = {}

    reader = open_log(log)
    for part in reader.slices():
        for name, topic in part.topics.items():
            if topic.data:
                counts[name] = counts.get(name, 0) + len(topic.data)

    assert reader.about.topics["/wave/state"].data == ()
    assert counts == {"/wave/state": 51, "/wave/odometry": 50, "/slow/state": 11, "/slow/odometry": 10}
