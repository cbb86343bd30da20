"""Live topics at the gateway: the newest, all behind a number, and what a slow client misses."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

import numpy as np
import pytest

from dxlrun import Floats
from dxlrun.channels.events import EventCode, Severity
from dxlrun.channels.messages import Topic, TopicMessage
from dxlrun.messages import Header
from dxlrun.messages.declared import declared_message
from dxlrun.remote.topics import ANSWER_BYTES, KEPT_BYTES, KEPT_MESSAGES, MOST_PER_ANSWER, LiveTopic


@dataclass
class State:
    header: Header
    error: Floats
    text: str = ""


DECLARED = declared_message(State, "mine")
TOPIC = Topic("/left/state", DECLARED.type, ("pan", "tilt"))


def publish(desk, number, first, last, text=""):
    for index in range(first, last + 1):
        data = DECLARED.pack(State(Header(), np.array([index, np.nan]), text), (index, 0))
        desk.messages.message(number, index * 10_000_000, data)
    desk.link.collect()


@pytest.fixture
def number(desk):
    return desk.messages.announce(TOPIC)


def numbers(answer):
    return [one["number"] for one in answer["messages"]]


def test_all_topics_are_listed_with_their_types_and_rates(desk, number):
    publish(desk, number, 1, 5)
    status, found = desk.ask("GET", "/topics")
    assert status == 200
    state, events, joints = found["topics"]
    assert state == {
        "name": "/left/state",
        "type": "mine/msg/State",
        "joints": ["pan", "tilt"],
        "count": 5,
        "rate": pytest.approx(100.0),
    }
    assert (events["name"], events["type"]) == ("/events", "dxlrun_msgs/msg/Event")
    assert (joints["name"], joints["type"]) == ("/joint_states", "sensor_msgs/msg/JointState")


def test_the_newest_message_is_json_and_nan_is_null(desk, number):
    assert desk.ask("GET", "/topics/left/state")[1]["messages"] == []
    publish(desk, number, 1, 3)
    _, found = desk.ask("GET", "/topics/left/state")
    assert found["messages"] == [
        {
            "number": 3,
            "time": pytest.approx(0.03),
            "message": {
                "header": {"stamp": {"sec": 3, "nanosec": 0}, "frame_id": ""},
                "error": [3.0, None],
                "text": "",
            },
        }
    ]
    assert (found["last"], found["lost"], found["joints"]) == (3, 0, ["pan", "tilt"])


def test_a_client_gets_each_message_once_in_answers_of_bounded_length(desk, number):
    publish(desk, number, 1, 2 * MOST_PER_ANSWER + 5)
    seen, last = [], 0
    for _ in range(3):
        _, found = desk.ask("GET", f"/topics/left/state?after={last}")
        assert found["lost"] == 0
        seen += numbers(found)
        last = found["last"]
    assert seen == list(range(1, 2 * MOST_PER_ANSWER + 6))
    assert desk.ask("GET", f"/topics/left/state?after={last}")[1]["messages"] == []


def test_a_slow_client_is_told_how_many_it_missed(desk, number):
    publish(desk, number, 1, KEPT_MESSAGES + 100)
    _, found = desk.ask("GET", "/topics/left/state?after=10")
    assert numbers(found)[0] == 101
    assert found["lost"] == 90


def test_long_messages_are_kept_within_their_bytes():
    live = LiveTopic(TOPIC)
    data = DECLARED.pack(State(Header(), np.zeros(0), "x" * 60_000), (0, 0))
    for index in range(100):
        live.keep(TopicMessage(index, 0, data))
    kept = live.after(0)
    assert live.count == 100
    assert kept.lost >= 100 - KEPT_BYTES // 60_000
    assert sum(map(len, [one.data for one in live._kept])) <= KEPT_BYTES


def test_an_answer_has_no_more_bytes_than_it_may():
    live = LiveTopic(TOPIC)
    data = DECLARED.pack(State(Header(), np.zeros(0), "x" * 60_000), (0, 0))
    for index in range(10):
        live.keep(TopicMessage(index, 0, data))
    first = live.after(0)
    assert [one.number for one in first.messages] == list(range(1, first.last + 1))
    assert first.last <= ANSWER_BYTES // 60_000 + 1
    assert live.after(first.last).messages[0].number == first.last + 1


def test_a_request_waits_for_the_next_message(desk, number):
    publish(desk, number, 1, 1)

    async def waits():
        asked = asyncio.ensure_future(desk.request("GET", "/topics/left/state?after=1&wait=5"))
        for _ in range(3):
            await asyncio.sleep(0)
        assert not asked.done()
        publish(desk, number, 2, 2)
        return await asked

    status, found = asyncio.run(waits())
    assert (status, numbers(found)) == (200, [2])


def test_events_and_the_states_of_the_joints_are_topics_too(desk):
    desk.events.emit(EventCode.COMMAND, Severity.INFO, "left", "first")
    desk.events.emit(EventCode.COMMAND, Severity.INFO, "left", "second")
    _, found = desk.ask("GET", "/topics/events")
    assert [one["message"]["text"] for one in found["messages"]] == ["second"]
    _, found = desk.ask("GET", "/topics/events?after=0")
    assert [one["message"]["text"] for one in found["messages"]] == ["first", "second"]
    desk.record.states.position[:] = (0.5, np.nan)
    desk.finish_cycle()
    _, found = desk.ask("GET", "/topics/joint_states")
    (message,) = found["messages"]
    assert message["message"]["name"] == ["pan", "tilt"]
    assert message["message"]["position"] == [0.5, None]
    assert desk.ask("GET", f"/topics/joint_states?after={message['number']}")[1]["messages"] == []


def test_an_unknown_topic_is_refused_with_those_that_exist(desk, number):
    publish(desk, number, 1, 1)
    status, found = desk.ask("GET", "/topics/left/states")
    assert (status, found["code"]) == (404, "unknown_topic")
    expected = "there is no topic /left/states; there are /left/state, /events, /joint_states"
    assert found["refused"] == expected
    assert desk.ask("GET", "/topics/left/state?wait=60")[0] == 422


def test_the_numbers_go_on_when_a_controller_is_loaded_again(desk, number):
    publish(desk, number, 1, 3)
    publish(desk, desk.messages.announce(TOPIC), 4, 4)
    _, found = desk.ask("GET", "/topics/left/state?after=0")
    assert numbers(found) == [4]


def test_a_damaged_record_takes_nothing_along(desk, number):
    publish(desk, number, 1, 1)
    desk.message_ring.append(7, b"short")
    desk.message_ring.append(8, b"short")
    desk.messages.message(99, 0, b"of no topic")
    publish(desk, number, 2, 2)
    _, found = desk.ask("GET", "/topics/left/state?after=0")
    assert numbers(found) == [1, 2]
