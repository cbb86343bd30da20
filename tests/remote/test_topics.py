"""Live topics at the gateway: what a stream has and what a client misses; and frames of a running robot."""

import json
from dataclasses import dataclass

import numpy as np
import pytest
from msgspec.structs import replace

import dxlrun
from dxlrun import Floats
from dxlrun.channels.cycle import CycleLayout, CycleRecord
from dxlrun.channels.event_records import EventBody, EventCode, Severity
from dxlrun.channels.topic_messages import PublishedTopic
from dxlrun.description.frames.tree import ORIENTATION, FramesPlan
from dxlrun.messages import Header
from dxlrun.messages.cdr import Codec
from dxlrun.messages.declared import declared_message
from dxlrun.messages.definition import MessageType
from dxlrun.remote.client import RemoteRobot
from dxlrun.remote.live.live_topics import MOST_RECORDS
from dxlrun.remote.requests.replies import StreamMessage, StreamTopic


@dataclass
class State:
    header: Header
    error: Floats
    text: str = ""


DECLARED = declared_message(State, "mine")
TOPIC = PublishedTopic("/left/state", DECLARED.type, ("pan", "tilt"))


def publish(desk, number, first, last, text=""):
    for index in range(first, last + 1):
        data = DECLARED.pack(State(Header(), np.array([index, np.nan]), text), (index, 0))
        desk.messages.message(number, index * 10_000_000, data)
    desk.link.collect_messages()


@pytest.fixture
def number(desk):
    """The number of an announced topic."""
    number = desk.messages.announce(TOPIC)
    desk.link.collect_messages()
    return number


def samples(desk, stream):
    return [one for one in desk.frames(stream) if isinstance(one, StreamMessage)]


def numbers(desk, stream):
    return [one.number for one in samples(desk, stream)]


def test_all_topics_are_listed_with_their_types_and_rates(desk, number):
    publish(desk, number, 1, 5)
    status, found = desk.ask("GET", "/topics")
    assert status == 200
    state, *others = found["topics"]
    assert state == {
        "name": "/left/state",
        "type": "mine/msg/State",
        "joints": ["pan", "tilt"],
        "count": 5,
        "rate": pytest.approx(100.0),
    }
    assert [(one["name"], one["type"], one["count"]) for one in others] == [
        ("/events", "dxlrun_msgs/msg/Event", 0),
        ("/cycle", "dxlrun_msgs/msg/Cycle", 1),
        ("/joint_states", "sensor_msgs/msg/JointState", 1),
    ]


def test_a_stream_begins_with_what_the_topic_is_and_its_newest_message(desk, number):
    assert numbers(desk, desk.link.open_stream(["/left/state"], newest=False)) == []
    publish(desk, number, 1, 3)
    opened, sample = desk.frames(desk.link.open_stream(["/left/state"], newest=False))
    assert opened == StreamTopic(0, "/left/state", DECLARED.type.name, DECLARED.type.text, ("pan", "tilt"), 0)
    assert (sample.place, sample.number, sample.time_ns) == (0, 3, 30_000_000)
    message = Codec(MessageType(opened.type, opened.definition)).unpack(sample.data)
    assert message["error"].tolist() == [3.0, pytest.approx(np.nan, nan_ok=True)]


def test_each_message_comes_once_to_each_of_two_clients_at_their_own_pace(desk, number):
    publish(desk, number, 1, 1)
    quick, slow = (desk.link.open_stream(["/left/state"], newest=False) for _ in range(2))
    seen = []
    for last in range(2, 2 * MOST_RECORDS, 5):
        publish(desk, number, last, last + 4)
        seen += numbers(desk, quick)
    assert seen == numbers(desk, slow) == list(range(1, last + 5))
    assert numbers(desk, slow) == []


def test_of_much_a_part_is_taken_at_once_so_that_others_are_served(desk, number):
    publish(desk, number, 1, 1)
    stream = desk.link.open_stream(["/left/state"], newest=False)
    publish(desk, number, 2, 3 * MOST_RECORDS)
    stream.frames()
    assert stream.behind
    assert numbers(desk, stream)[-1] == 3 * MOST_RECORDS
    assert not stream.behind


def test_the_numbers_show_exactly_what_a_client_that_slept_has_missed(desk, number):
    """The ring has room for less than what is published meanwhile; other topics share it."""
    other = desk.messages.announce(PublishedTopic("/right/state", DECLARED.type))
    publish(desk, number, 1, 1)
    stream = desk.link.open_stream(["/left/state"], newest=False)
    assert numbers(desk, stream) == [1]
    for index in range(2, 60):
        publish(desk, other, index, index, "x" * 30_000)
        publish(desk, number, index, index)
    found = numbers(desk, stream)
    assert found[0] > 2
    assert found == list(range(found[0], 60))


def test_of_the_newest_only_the_last_comes_of_each_topic(desk, number):
    stream = desk.link.open_stream(["/joint_states", "/left/state"], newest=True)
    assert [(one.place, one.number) for one in samples(desk, stream)] == [(0, 1)]
    publish(desk, number, 1, 9)
    for _ in range(4):
        desk.finish_cycle()
    assert [(one.place, one.number) for one in samples(desk, stream)] == [(1, 9), (0, 5)]


def test_events_and_every_cycle_are_topics_too(desk):
    desk.events.emit_event("left", EventBody(EventCode.COMMAND, Severity.INFO, "first"))
    desk.events.emit_event("left", EventBody(EventCode.COMMAND, Severity.INFO, "second"))
    desk.link.collect_messages()
    stream = desk.link.open_stream(["/events", "/joint_states", "/cycle"], newest=False)
    event, states, cycle, *newest = desk.frames(stream)
    assert [(one.place, one.number) for one in newest] == [(1, 1), (2, 1), (0, 2)]
    codecs = [Codec(MessageType(one.type, one.definition)) for one in (event, states, cycle)]
    desk.events.emit_event("left", EventBody(EventCode.COMMAND, Severity.INFO, "third"))
    desk.link.collect_messages()
    (sample,) = samples(desk, stream)
    assert codecs[0].unpack(sample.data)["text"] == "third"
    desk.record.states.position[:] = (0.5, np.nan)
    desk.finish_cycle()
    states, cycle = samples(desk, stream)
    assert (states.number, cycle.number) == (2, 2)
    assert codecs[1].unpack(states.data)["name"] == ["pan", "tilt"]
    assert codecs[1].unpack(states.data)["position"].tolist()[0] == 0.5
    assert cycle.data[4:] == bytes(desk.record.raw)
    assert codecs[2].unpack(cycle.data)["position"].tolist()[0] == 0.5
    assert samples(desk, stream) == []


def test_cycles_that_are_missing_show_in_the_numbers_though_their_own_numbers_skip_too(desk):
    """A loop that skips periods leaves out numbers of cycles: those are no messages."""
    stream = desk.link.open_stream(["/joint_states"], newest=False)
    assert numbers(desk, stream) == [1]
    desk.ended += 100
    desk.finish_cycle()
    assert numbers(desk, stream) == [2]
    for _ in range(40):  # more than the ring holds
        desk.finish_cycle()
    found = numbers(desk, stream)
    assert found[0] > 3
    assert found == list(range(found[0], 43))


def test_the_numbers_go_on_when_a_controller_is_loaded_again(desk, number):
    publish(desk, number, 1, 3)
    stream = desk.link.open_stream(["/left/state"], newest=False)
    publish(desk, desk.messages.announce(TOPIC), 4, 4)
    found = desk.frames(stream)
    assert [type(one) for one in found] == [StreamTopic, StreamMessage, StreamTopic, StreamMessage]
    assert [one.number for one in found if isinstance(one, StreamMessage)] == [3, 4]
    assert numbers(desk, desk.link.open_stream(["/left/state"], newest=False)) == [4]


def test_a_damaged_record_takes_nothing_along(desk, number):
    publish(desk, number, 1, 1)
    stream = desk.link.open_stream(["/left/state"], newest=False)
    desk.message_ring.append(7, b"short")
    desk.message_ring.append(8, b"short")
    desk.message_ring.append(8, bytes(8) + b"\x63" + bytes(30))  # of topic 99, which there is not
    publish(desk, number, 2, 2)
    assert numbers(desk, stream) == [1, 2]


URDF = """<robot name="pair">
<link name="base_link"/><link name="imu_link"/><link name="pan"/><link name="tilt"/>
<joint name="mount" type="fixed"><parent link="base_link"/><child link="imu_link"/></joint>
<joint name="pan" type="revolute"><parent link="base_link"/><child link="pan"/><axis xyz="0 0 1"/></joint>
<joint name="tilt" type="prismatic"><parent link="pan"/><child link="tilt"/><origin xyz="1 0 0"/></joint>
</robot>"""


class DeskLink:
    """Requests to the gateway without a socket."""

    def __init__(self, desk):
        self.asked, self._desk = [], desk

    def exchange(self, method, path, body):
        self.asked.append(path)
        status, answer = self._desk.ask(method, path)
        return status, json.dumps(answer).encode()


def with_urdf(desk, imu=""):
    """Let the robot of a desk have the URDF, and its IMU lie on its side once it is known."""
    layout = CycleLayout(("pan", "tilt"), ("left", "right", "spare"), (), {"imu": ORIENTATION})
    desk.record, desk.link._record = CycleRecord(layout), CycleRecord(layout)
    loop = replace(desk.link.plan.loop, urdf=URDF)
    desk.link.plan = replace(desk.link.plan, loop=loop, frames=FramesPlan(30.0, ("pan", "tilt"), imu))
    link = DeskLink(desk)
    return RemoteRobot("pair", link), link


def test_a_pose_is_that_of_the_newest_cycle(desk):
    robot, link = with_urdf(desk)
    for pan, tilt in ((np.pi / 2, 0.5), (0.0, -0.25)):
        desk.record.states.position[:] = (pan, tilt)
        desk.finish_cycle()
        found = robot.pose("tilt", "base_link")
        assert found.translation == pytest.approx(((1 + tilt) * np.cos(pan), (1 + tilt) * np.sin(pan), 0))
    assert robot.frames().pose("tilt", "pan", {"tilt": 3.0}).translation == (4, 0, 0)
    assert link.asked.count("/frames") == 1  # the tree stays as it is


def test_what_is_not_known_has_no_pose(desk):
    robot, _ = with_urdf(desk)
    desk.record.states.position[:] = (np.nan, 0.5)
    desk.finish_cycle()

    with pytest.raises(ValueError, match="a position is missing"):
        robot.pose("tilt", "base_link")
    assert robot.pose("tilt", "pan").translation == (1.5, 0, 0)
    with pytest.raises(LookupError, match=r"frame tlt not found; did you mean tilt\?"):
        robot.pose("tlt")


def test_the_body_turns_with_its_imu(desk):
    robot, _ = with_urdf(desk, "imu")
    desk.record.states.position[:] = (0.0, 0.0)
    desk.finish_cycle()
    with pytest.raises(ValueError, match="a position is missing"):
        robot.pose("pan", "odom")
    desk.record.sources.values[:] = (2.0, 0.0, 0.0, 2.0)  # on its side, and not of length 1
    desk.finish_cycle()

    assert robot.pose("pan", "odom").rpy == pytest.approx((np.pi / 2, 0, 0))
    states = robot.states()
    assert states.joint("pan")["position"] == 0.0
    assert states.joint("pan")["temperature"] is None
    assert (states.source_states[0], states.source_state[0]) == ("imu/orientation.x", 2.0)


def test_a_robot_without_a_urdf_says_so(desk):
    with pytest.raises(dxlrun.DxlrunError, match=r"pair has no URDF; write `model: {urdf"):
        RemoteRobot("pair", DeskLink(desk)).frames()
