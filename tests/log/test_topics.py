"""Topics of controllers, inputs and diagnostics in the log: other programs decode them without our code."""

import json
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.decoded import decode_log

from dxlrun import Floats, LogError
from dxlrun.channels.commands import CommandRing, TakenCommand
from dxlrun.channels.cycle import CycleLayout, CycleRecord
from dxlrun.channels.ring import Handover, RecordKind
from dxlrun.channels.topic_messages import MessageRing, PublishedTopic
from dxlrun.log import schemas
from dxlrun.log.log_reader import open_log, read_log
from dxlrun.log.packing.diagnostics import Diagnostics
from dxlrun.messages import Header, Odometry
from dxlrun.messages.cdr import Codec
from dxlrun.messages.declared import declared_message
from dxlrun_analysis.report import analyze_log, tables
from dxlwire.modes import Mode

PERIOD_NS = 20_000_000


@dataclass
class WaveState:
    header: Header
    time_s: float
    error: Floats
    names: tuple[str, ...]


@pytest.fixture
def waves(log, path, cycle):
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
            odometry = Odometry(child_frame_id="base")
            odometry.pose.pose.position.x, odometry.pose.covariance[35] = time_s, 0.5
            publish("odometry", t_ns, odometry)
    log.close()
    return path


def test_our_reader_has_messages_times_columns_and_slices(waves):
    read = read_log(waves)
    states = read.messages("/wave/state")
    assert (states[0]["names"], states[2]["names"]) == ([], ["pan", "tilt"])
    topic = read.topics["/wave/odometry"]
    assert (topic.type.name, len(topic.data)) == ("nav_msgs/msg/Odometry", 10)
    np.testing.assert_allclose(topic.column("pose.pose.position.x"), np.arange(10) * 0.1, atol=1e-9)
    assert topic.column("pose.covariance").shape == (10, 36)
    assert topic.t_ns.tolist() == read.cycles["woken_ns"][::5].tolist()
    rows = tables(analyze_log(waves))["topics"].rows
    assert [tuple(cell.text for cell in row[:3]) for row in rows] == [
        ("/wave/state", "my_robotics/msg/WaveState", "51"),
        ("/wave/odometry", "nav_msgs/msg/Odometry", "10"),
    ]
    reader = open_log(waves)
    found = [(name, len(topic.data)) for part in reader.slices() for name, topic in part.topics.items()]
    assert {name for name, _ in found} == {"/wave/state", "/wave/odometry"}
    assert sum(count for _, count in found) == 61
    assert reader.about.topics["/wave/state"].data == ()


@pytest.mark.parametrize(
    ("topic", "field", "reason"),
    [
        ("/wave/state", "header.stamp.year", "messages of /wave/state have no field header.stamp.year"),
        ("/wave/state", "error", "error of /wave/state is not always of the same length"),
        ("/wave/states", "", "no topic /wave/states; did you mean /wave/state?"),
    ],
)
def test_what_a_log_does_not_have_is_one_sentence(waves, topic, field, reason):
    read = read_log(waves)
    with pytest.raises(LogError, match=re.escape(reason)):
        read.topics[topic].column(field) if field else read.messages(topic)


# What controllers were activated with, and the commands that they took

STEERING = TakenCommand(6_600, 4, -1, "", "switch", "anna", b'{"activate":["head"],"deactivate":[]}')
NUMBERS = np.array([0.5, -0.0, np.nan]).tobytes()
TAKEN = (
    TakenCommand(5_000, 3, 7, "left_arm", "trajectory", "wave.yaml:7:5", b""),
    TakenCommand(6_000, 4, -1, "head", "positions", "anna", NUMBERS),
    TakenCommand(6_500, 4, -1, "head", "positions", "anna", NUMBERS[:8], lease_ns=200_000_000),
    STEERING,
    TakenCommand(6_700, 4, -1, "", "load", "anna", b'{"name":"' + b"n" * 2000 + b'"}'),
    TakenCommand(6_800, 4, -1, "head", "positions", "mallory", b"thirteen byte"),
)


def test_inputs_come_back_as_they_were_and_another_reader_decodes_them(log, path, cycle):
    log.write_record(RecordKind.CYCLE, cycle(-1))
    ring = CommandRing(Handover(log.write_record))
    for number in range(5):
        for command in TAKEN:
            if command.cycle == number:
                ring.record_command(command)
        log.write_record(RecordKind.CYCLE, cycle(number))
    log.close()
    read = read_log(path)
    assert (read.commands, read.complete) == (TAKEN, True)
    assert read.activation is not None
    assert read.activation.tobytes() == cycle(-1)
    assert read.cycles["cycle"].tolist() == [0, 1, 2, 3, 4]
    assert [one.message.cycle for one in decode_log(path, "/activation")] == [-1]
    planned, given, streamed, steering, *_ = (one.message for one in decode_log(path, "/commands"))
    assert (planned.cycle, planned.planned, planned.controller, list(planned.data)) == (3, 7, "left_arm", [])
    assert (given.planned, given.kind, given.origin) == (-1, "positions", "anna")
    assert np.array(given.data).tobytes() == NUMBERS
    assert (streamed.lease_ns, list(streamed.data), streamed.text) == (200_000_000, [0.5], "")
    assert (steering.controller, steering.kind, list(steering.data)) == ("", "switch", [])
    assert steering.text == STEERING.data.decode()


@pytest.mark.parametrize("data", [b'{"a": "\xff"}', b"\xfe", b""])
def test_what_was_no_json_is_none_in_the_log(log, path, data):
    CommandRing(Handover(log.write_record)).record_command(replace(STEERING, data=data))
    log.close()
    read = read_log(path)
    (command,) = read.commands
    with pytest.raises(ValueError, match=r"Expecting|Invalid"):
        json.loads(command.data)
    assert (read.complete, read.activation) == (True, None)


# How each servo is, in words that any ROS tool shows


def test_each_joint_has_the_status_of_its_servo_once_a_second():
    record = CycleRecord(CycleLayout(("elbow", "wheel", "head"), ()))
    states = record.states
    states.temperature[:] = 41.0, np.nan, 70.0
    states.voltage[:] = 12.04, np.nan, 11.0
    states.valid[:] = True, False, True
    states.hardware_error[:] = 0, 0, 0x24
    states.mode[:] = Mode.POSITION, Mode.UNKNOWN, Mode.EFFORT
    row = np.frombuffer(bytes(record.raw), dtype=record.layout.dtype)[0]
    diagnostics = Diagnostics(("elbow", "wheel", "head"))
    packed = {
        t_ns: diagnostics.pack_diagnostics(row, t_ns, (7, 8)) for t_ns in range(0, 5 * 10**9, PERIOD_NS)
    }
    assert [t_ns for t_ns, data in packed.items() if data] == [s * 10**9 for s in range(5)]
    message: Any = Codec(schemas.DIAGNOSTICS).unpack(packed[0] or b"")
    assert message["header"]["stamp"] == {"sec": 7, "nanosec": 8}
    found = [
        (one["level"], one["name"], one["message"], *(pair["value"] for pair in one["values"]))
        for one in message["status"]
    ]
    assert found == [
        (0, "elbow", "answers", "41.0 deg C", "12.0 V", "0x00", "position"),
        (3, "wheel", "did not answer in this cycle", "not read yet", "not read yet", "0x00", "unknown"),
        (2, "head", "hardware error 0x24", "70.0 deg C", "11.0 V", "0x24", "effort"),
    ]
