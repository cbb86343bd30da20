"""`dxlrun echo`: messages of a topic as a person reads them, as programs do, and its ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any

import pytest
from tests.kit.answers import result_of

from dxlrun.cli.steering import echo as module
from dxlrun.cli.steering.echo import fields
from dxlrun.messages.cdr import Codec
from dxlrun.messages.definition import MessageType
from dxlrun.remote.live.listening import TopicMessage
from dxlrun.remote.requests.replies import TopicState

MESSAGE: dict[str, object] = {
    "header": {"stamp": {"sec": 3, "nanosec": 0}, "frame_id": ""},
    "good": True,
    "count": 12,
    "share": 0.123456789,
    "error": [0.5, None],
    "square": [1.0, 2.0, 3.0],
    "names": ["pan", "tilt"],
    "parts": [{"name": "one", "rows": []}, {"name": "two", "rows": [1]}],
}


class Robot:
    """A running robot that sends what the test has."""

    def __init__(self, messages: list[TopicMessage], after: BaseException | None = None) -> None:
        self.messages = messages
        self.after = after
        self.asked: list[tuple[str, float | None]] = []

    def __enter__(self) -> Robot:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def topics(self) -> list[TopicState]:
        return [
            TopicState("/arm/state", "mine/msg/State", ("pan",), 12, 49.96),
            TopicState("/events", "dxlrun_msgs/msg/Event", (), 3, None),
        ]

    def listen(self, topic: str, *, rate: float | None) -> Iterator[TopicMessage]:
        self.asked.append((topic, rate))
        yield from self.messages
        if self.after is not None:
            raise self.after


@pytest.fixture
def running(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Robot]:
    def start(*arguments: Any) -> Robot:
        robot = Robot(*arguments)
        monkeypatch.setattr(module, "connect_robot", lambda name, verb: robot)
        return robot

    return start


CODEC = Codec(MessageType("mine/msg/State", "float64 share\n"))


def message(number: int, lost: int = 0) -> TopicMessage:
    data, kind = CODEC.pack(float(number)), CODEC.message
    return TopicMessage("/arm/state", kind.name, number, 1_500_000_000, 0, lost, data, kind.text)


def test_rows_of_joints_have_their_names_and_other_rows_do_not() -> None:
    assert (
        "\n".join(fields(MESSAGE, ("pan", "tilt")))
        == """\
header:
  stamp:
    sec: 3
    nanosec: 0
  frame_id: ""
good: true
count: 12
share: 0.123457
error:
  pan: 0.5
  tilt: nan
square: [1, 2, 3]
names: [pan, tilt]
parts:
- name: one
  rows: []
- name: two
  rows: [1]"""
    )


def test_a_message_that_names_its_joints_is_read_by_them() -> None:
    lines = fields({"joint_names": ["a", "b", "c"], "output": {"effort": [1.0, 2.0, 3.0]}}, ("pan", "tilt"))
    assert lines == ["joint_names: [a, b, c]", "output:", "  effort:", "    a: 1", "    b: 2", "    c: 3"]


def test_messages_are_printed_until_there_are_no_more(dxlrun: Any, running: Callable[..., Robot]) -> None:
    robot = running([message(7), message(9, lost=1)])
    said = dxlrun("echo", "/arm/state", "--rate", "5")
    assert (said.code, said.err, robot.asked) == (0, "", [("/arm/state", 5.0)])
    assert said.out == (
        "--- /arm/state 7, 1.500 s\nshare: 7\n--- /arm/state 9, 1.500 s, 1 missed before it\nshare: 9\n"
    )


def test_a_count_ends_it(dxlrun: Any, running: Callable[..., Robot]) -> None:
    running([message(1), message(2), message(3)])
    lines = dxlrun("echo", "arm/state", "--count", "2", "--json").out.splitlines()
    assert [result_of(line)["number"] for line in lines] == [1, 2]
    assert result_of(lines[0]) == {
        "topic": "/arm/state", "number": 1, "time": 1.5, "lost": 0, "message": {"share": 1.0},
    }  # fmt: skip


def test_ctrl_c_is_its_usual_end(dxlrun: Any, running: Callable[..., Robot]) -> None:
    running([message(1)], KeyboardInterrupt())
    said = dxlrun("echo", "/arm/state")
    assert (said.code, said.err) == (0, "")


def test_without_a_topic_all_are_listed(dxlrun: Any, running: Callable[..., Robot]) -> None:
    running([])
    rows = [line.split() for line in dxlrun("echo").out.splitlines()]
    assert rows[2:] == [
        ["/arm/state", "mine/msg/State", "12", "49.96", "Hz"],
        ["/events", "dxlrun_msgs/msg/Event", "3"],
    ]
    assert [row["name"] for row in result_of(dxlrun("echo", "--json").out)] == ["/arm/state", "/events"]
