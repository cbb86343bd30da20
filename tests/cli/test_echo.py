"""`dxlrun echo`: messages of a topic as a person reads them, as programs do, and its ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from tests.kit.answers import result_of
from tests.kit.commands import Dxlrun

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
SHOWN = """\
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
CODEC = Codec(MessageType("mine/msg/State", "float64 share\n"))
STATES = [
    TopicState("/arm/state", "mine/msg/State", ("pan",), 12, 49.96),
    TopicState("/events", "dxlrun_msgs/msg/Event", (), 3, None),
]


def message(number: int, lost: int = 0) -> TopicMessage:
    data, kind = CODEC.pack(float(number)), CODEC.message
    return TopicMessage("/arm/state", kind.name, number, 1_500_000_000, 0, lost, data, kind.text)


class Robot:
    """A running robot that sends what the test has."""

    def __init__(self, messages: list[TopicMessage], after: BaseException | None = None) -> None:
        self.messages, self.after = messages, after
        self.asked: list[tuple[str, float | None]] = []

    def __enter__(self) -> Robot:
        return self

    def __exit__(self, *_: object) -> None: ...

    def topics(self) -> list[TopicState]:
        return STATES

    def listen(self, topic: str, *, rate: float | None) -> Iterator[TopicMessage]:
        self.asked.append((topic, rate))
        yield from self.messages
        if self.after is not None:
            raise self.after


Running = Callable[..., Robot]


@pytest.fixture
def running(monkeypatch: pytest.MonkeyPatch) -> Running:
    def start(*messages: TopicMessage, after: BaseException | None = None) -> Robot:
        robot = Robot([*messages], after)
        monkeypatch.setattr(module, "connect_robot", lambda name, verb: robot)
        return robot

    return start


def test_rows_of_joints_have_their_names_and_other_rows_do_not() -> None:
    assert "\n".join(fields(MESSAGE, ("pan", "tilt"))) == SHOWN
    lines = fields({"joint_names": ["a", "b", "c"], "output": {"effort": [1.0, 2.0, 3.0]}}, ("pan", "tilt"))
    assert lines == ["joint_names: [a, b, c]", "output:", "  effort:", "    a: 1", "    b: 2", "    c: 3"]


def test_messages_are_printed_until_there_are_no_more(dxlrun: Dxlrun, running: Running) -> None:
    robot = running(message(7), message(9, lost=1))
    said = dxlrun("echo", "/arm/state", "--rate", "5")
    assert (said.code, said.err, robot.asked) == (0, "", [("/arm/state", 5.0)])
    assert said.out == (
        "--- /arm/state 7, 1.500 s\nshare: 7\n--- /arm/state 9, 1.500 s, 1 missed before it\nshare: 9\n"
    )


def test_count_and_ctrl_c_end_it(dxlrun: Dxlrun, running: Running) -> None:
    running(message(1), message(2), message(3))
    lines = dxlrun("echo", "arm/state", "--count", "2", "--json").out.splitlines()
    first, second = (result_of(line) for line in lines)
    assert second["number"] == 2
    whole = {"topic": "/arm/state", "number": 1, "time": 1.5, "lost": 0, "message": {"share": 1.0}}
    assert first == whole
    running(message(1), after=KeyboardInterrupt())
    said = dxlrun("echo", "/arm/state")
    assert (said.code, said.err) == (0, "")


def test_without_a_topic_all_are_listed(dxlrun: Dxlrun, running: Running) -> None:
    running()
    rows = [line.split() for line in dxlrun("echo").out.splitlines()]
    assert rows[2:] == [
        ["/arm/state", "mine/msg/State", "12", "49.96", "Hz"],
        ["/events", "dxlrun_msgs/msg/Event", "3"],
    ]
    assert [row["name"] for row in result_of(dxlrun("echo", "--json").out)] == ["/arm/state", "/events"]
