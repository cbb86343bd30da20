"""Published: the messages of a replay against those in the log, byte by byte."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import msgspec
import numpy as np

from dxlrun.errors import counted
from dxlrun.log.reader import UNREADABLE, Log
from dxlrun.log.reading.topics import LoggedTopic
from dxlrun.log.schemas import MACHINE_TOPIC
from dxlrun.messages.cdr import Codec
from dxlrun.run.channels.events import EventCode, LostRecords
from dxlrun.run.channels.messages import Topic

RING = "loop/messages"
_LONGEST_SHOWN = 120


@dataclass(frozen=True, slots=True)
class MessageDifference:
    """One message that is not the same."""

    t_ns: int
    """Wake-up of its cycle, ns of the run's clock."""
    topic: str
    field: str
    """The first that differs: `error[1]`; empty: the message is in one of the two only, or another type."""
    recorded: str
    replayed: str


@dataclass(slots=True)
class _Pending:
    """A topic of the log, and which of its messages the replay comes to next."""

    logged: LoggedTopic
    times: list[int]
    next: int = 0


class MessageComparison:
    """Takes what a replayed loop publishes, and compares it with the log as it comes.

    Topics that the log does not have are not compared: it is from a dxlrun that did not publish them.
    """

    def __init__(self, log: Log, until_ns: int, *, whole: bool) -> None:
        """`until_ns`: wake-up of the last compared cycle; `whole`: the run ended with it, in order."""
        self.first: MessageDifference | None = None
        self.compared = 0
        self.different = 0
        self._topics = {
            name: _Pending(one, one.t_ns.tolist())
            for name, one in log.topics.items()
            if name != MACHINE_TOPIC
        }
        self._announced: list[tuple[str, Topic]] = []
        self._until_ns = until_ns
        self._whole = whole
        self.lost = _lost(log)
        """Messages that the recorder did not get: those of the replay have none to be compared with."""

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a person should know about the comparison."""
        if not self.lost:
            return ()
        return (f"the log misses {counted(self.lost, 'message', 'messages')} of topics",)

    def announce(self, topic: Topic) -> int:
        """Take a topic; return its number."""
        self._announced.append((topic.name, topic))
        return len(self._announced) - 1

    def message(self, topic: int, t_ns: int, data: bytes) -> None:
        """Compare one message."""
        name, announced = self._announced[topic]
        pending = self._topics.get(name)
        if pending is None or t_ns > self._until_ns:
            return
        self._pass(pending, t_ns)
        if pending.next < len(pending.times) and pending.times[pending.next] == t_ns:
            recorded = pending.logged.data[pending.next]
            pending.next += 1
            self.compared += 1
            if recorded != data:
                self._differs(t_ns, name, *_where(pending.logged, announced, recorded, data))
        elif not self.lost and (self._whole or t_ns < self._until_ns):
            self.compared += 1
            self._differs(t_ns, name, "", "no message", "a message")

    def finish(self, reached_ns: int) -> None:
        """Look for messages that the replay did not publish, up to the cycle that it reached."""
        for pending in self._topics.values():
            self._pass(pending, min(reached_ns, self._until_ns) + 1)

    def _pass(self, pending: _Pending, t_ns: int) -> None:
        """Go past recorded messages from before this time: the replay has none for them."""
        while pending.next < len(pending.times) and pending.times[pending.next] < t_ns:
            self.compared += 1
            at_ns = pending.times[pending.next]
            pending.next += 1
            self._differs(at_ns, pending.logged.name, "", "a message", "no message")

    def _differs(self, t_ns: int, topic: str, field: str, recorded: str, replayed: str) -> None:
        self.different += 1
        if self.first is None or t_ns < self.first.t_ns:
            self.first = MessageDifference(t_ns, topic, field, recorded, replayed)


def _lost(log: Log) -> int:
    lost = 0
    for event in log.events:
        if event.code == EventCode.RECORDER_GAP:
            try:
                data = msgspec.json.decode(event.data, type=LostRecords)
            except UNREADABLE:
                continue
            lost += data.lost if data.ring == RING else 0
    return lost


def _where(logged: LoggedTopic, now: Topic, recorded: bytes, replayed: bytes) -> tuple[str, str, str]:
    """Return the first field that differs, and its values."""
    if (logged.type.name, logged.type.text) != (now.type.name, now.type.text):
        return "", f"type {logged.type.name}", f"another definition of {now.type.name}"
    codec = Codec(now.type)
    try:
        then, here = (_leaves(codec.unpack(data), "") for data in (recorded, replayed))
    except ValueError:
        return "", f"{len(recorded)} bytes that are no {now.type.name}", f"{len(replayed)} bytes"
    for field, value in then.items():
        if field not in here:
            return field, value, "nothing"
        if here[field] != value:
            return field, value, here[field]
    more = next((field for field in here if field not in then), "")
    return more, "nothing", here.get(more, "the same fields in other bytes")


def _leaves(value: object, place: str) -> dict[str, str]:
    """Return all values that a message is made of, as text, by their places: `error[1]`."""
    if isinstance(value, Mapping):
        parts = [(f"{place}.{name}" if place else str(name), one) for name, one in value.items()]
    elif isinstance(value, np.ndarray | list):
        parts = [(f"{place}[{index}]", one) for index, one in enumerate(value)]
    elif isinstance(value, float | np.floating):
        return {place: f"{float(value)!r}{'' if np.isfinite(value) else f' (bits {_bits(value)})'}"}
    else:
        return {place: str(value)[:_LONGEST_SHOWN]}
    found: dict[str, str] = {}
    for name, one in parts:
        found |= _leaves(one, name)
    return found


def _bits(value: float | np.floating) -> str:
    return f"{int(np.float64(value).view(np.uint64)):#018x}"
