"""Topics of controllers: what they publish reaches the sink as it is, or is their fault in one sentence."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from tests.kit.loops import on_update

from dxlrun import ControllerFault, Floats
from dxlrun.channels.cycle import CycleLayout, CycleRecord
from dxlrun.channels.topic_messages import LONGEST_MESSAGE, PublishedTopic
from dxlrun.control.controllers.published_topics import MOST_PER_CYCLE, TopicLog
from dxlrun.messages import Header
from dxlrun.messages.cdr import Codec

EPOCH_NS = 1_700_000_000_000_000_000


@dataclass
class State:
    header: Header
    error: Floats
    text: str = ""


class Sink:
    def __init__(self) -> None:
        self.topics: list[PublishedTopic] = []
        self.messages: list[tuple[int, int, bytes]] = []

    def announce(self, topic: PublishedTopic) -> int:
        self.topics.append(topic)
        return len(self.topics) - 1

    def message(self, topic: int, t_ns: int, data: bytes) -> None:
        self.messages.append((topic, t_ns, data))


class Stage:
    """One controller's topics, in cycle 3."""

    def __init__(self) -> None:
        self.sink = Sink()
        self.record = CycleRecord(CycleLayout(["a", "b"], ["wave"]))
        self.record.wake(3, 0, 5_000_000_007, 1)
        log = TopicLog(self.record, self.sink, EPOCH_NS)
        self.goals = log.open("/goals", State)
        self.topics = log.of_controller("wave", 1)
        self.topics.open_topics({"state": State, "other": Header}, "My-Robotics 1.0", ("a", "b"))

    def read(self, index: int) -> Any:
        number, _, data = self.sink.messages[index]
        return Codec(self.sink.topics[number].type).unpack(data)


def state(rows: int = 2, text: str = "") -> State:
    return State(Header(frame_id="base"), np.full(rows, np.nan), text)


def test_topics_are_announced_and_a_message_has_the_time_of_the_cycle():
    stage = Stage()
    assert [(topic.name, topic.type.name, topic.joints) for topic in stage.sink.topics] == [
        ("/goals", "dxlrun_msgs/msg/State", ()),
        ("/wave/state", "my_robotics/msg/State", ("a", "b")),
        ("/wave/other", "std_msgs/msg/Header", ("a", "b")),
    ]
    stage.topics.publish("state", state(text="well"))
    ((number, t_ns, _),) = stage.sink.messages
    assert (number, t_ns) == (1, 5_000_000_007)
    found = stage.read(0)
    assert found["header"] == {"stamp": {"sec": 1_700_000_005, "nanosec": 7}, "frame_id": "base"}
    assert np.isnan(found["error"]).tolist() == [True, True], "NaN is a number"
    assert found["text"] == "well"


@pytest.mark.parametrize(
    ("topic", "message", "reason"),
    [
        ("states", state(), r"published on states, but its Topics are state, other"),
        ("state", {"a": 1}, "published an invalid message on topic state: dict given, State expected"),
        ("state", None, "NoneType given, State expected"),
        ("state", State(Header(), [1.0]), "State.error: list given, an array of float64 expected"),  # type: ignore[arg-type]
        ("state", state(text="x" * LONGEST_MESSAGE), f" bytes, more than {LONGEST_MESSAGE}"),
    ],
)
def test_what_a_topic_does_not_take_is_a_fault_and_reaches_nothing(topic, message, reason):
    stage = Stage()
    with pytest.raises(ControllerFault, match=reason):
        stage.topics.publish(topic, message)
    assert stage.sink.messages == []


def test_a_flood_in_one_cycle_is_a_fault_and_the_next_cycle_begins_anew():
    stage = Stage()
    for _ in range(MOST_PER_CYCLE):
        stage.topics.publish("state", state())
    with pytest.raises(ControllerFault, match=f"more than {MOST_PER_CYCLE} messages in a cycle"):
        stage.topics.publish("other", Header())
    stage.record.wake(4, 0, 6_000_000_000, 1)
    stage.topics.publish("other", Header())
    stage.record.wake(5, 0, 7_000_000_000, 1)  # what the cycle before left over counts no more
    for _ in range(MOST_PER_CYCLE):
        stage.topics.publish("state", state())
    with pytest.raises(ControllerFault, match=f"more than {MOST_PER_CYCLE} messages in a cycle"):
        stage.topics.publish("other", Header())
    assert len(stage.sink.messages) == 2 * MOST_PER_CYCLE + 1


def test_nothing_is_published_before_the_activation():
    stage = Stage()
    stage.record.woken_ns = 0
    with pytest.raises(ControllerFault, match="published on state before it was activated"):
        stage.topics.publish("state", state())


def test_a_controller_that_publishes_wrongly_is_ended_with_one_sentence(robot):
    result = robot.script("wave", on_update(lambda context, *_: context.publish("state", None))).run(4)
    assert result.reason == "fault"
    assert result.detail == "controller wave published on state, but its Topics are none"
