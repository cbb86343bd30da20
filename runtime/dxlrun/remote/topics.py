"""Live topics: the newest messages of the loop's topics, for clients that listen at their own pace.

The last messages of each topic are kept, bounded, for all clients together: one that is slower than its topic
misses some and is told how many, and the loop does not notice either.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from itertools import islice

import numpy as np

from dxlrun.channels.cycle import CycleRecord
from dxlrun.channels.events import Event
from dxlrun.channels.messages import Topic, TopicMessage, decode_message, decode_topic
from dxlrun.channels.ring import Record, RecordKind, RingReader
from dxlrun.log.schemas import EVENT, EVENT_TOPIC, JOINT_STATE, JOINT_STATES_TOPIC
from dxlrun.messages.cdr import Codec
from dxlrun.remote.replies import Message, Messages, TopicState

KEPT_MESSAGES = 512
KEPT_BYTES = 1 << 20
"""Of one topic: so many of its newest messages are kept, and so many bytes."""
MOST_PER_ANSWER = 128
"""Messages; a client asks again for what comes behind them."""
ANSWER_BYTES = 256 * 1024
"""Bytes of messages in one answer, before they become JSON."""


class LiveTopic:
    """The newest messages of one topic."""

    __slots__ = ("_bytes", "_codec", "_kept", "count", "topic")

    def __init__(self, topic: Topic, count: int = 0) -> None:
        self.topic = topic
        self.count = count
        self._codec = Codec(topic.type)
        self._kept: deque[TopicMessage] = deque()
        self._bytes = 0

    def keep(self, message: TopicMessage) -> None:
        """Keep a message, and let go of the oldest."""
        self.count += 1
        self._kept.append(message)
        self._bytes += len(message.data)
        while len(self._kept) > KEPT_MESSAGES or (self._bytes > KEPT_BYTES and len(self._kept) > 1):
            self._bytes -= len(self._kept.popleft().data)

    def state(self) -> TopicState:
        """Return what the list of topics has."""
        rate = None
        if len(self._kept) > 1 and (span_ns := self._kept[-1].t_ns - self._kept[0].t_ns) > 0:
            rate = (len(self._kept) - 1) * 1e9 / span_ns
        return TopicState(self.topic.name, self.topic.type.name, self.topic.joints, self.count, rate)

    def after(self, number: int | None) -> Messages:
        """Return the messages behind this number that are kept, at most as many as an answer has.

        None: the newest one alone.
        """
        first = self.count - len(self._kept) + 1
        begin = self.count if number is None else max(number + 1, first)
        lost = 0 if number is None or number > self.count else max(0, begin - number - 1)
        found: list[Message] = []
        size, index = 0, max(begin, first)
        while index <= self.count and len(found) < MOST_PER_ANSWER and size < ANSWER_BYTES:
            message = self._kept[index - first]
            size += len(message.data)
            with suppress(ValueError):  # none of ours: the loop encodes them
                found.append(Message(index, message.t_ns * 1e-9, _fields(self._codec.unpack(message.data))))
            index += 1
        topic = self.topic
        return Messages(topic.name, topic.type.name, topic.joints, (*found,), max(index - 1, 0), lost)


class LiveTopics:
    """All topics of the loop; reads their ring."""

    def __init__(self, memory: int) -> None:
        self.topics: dict[str, LiveTopic] = {}
        self._by_number: dict[int, LiveTopic] = {}
        self._ring = RingReader(memory)

    def collect(self) -> None:
        """Take what has come; the log declares what was lost on the way."""
        while (record := self._ring.read()) is not None:
            if isinstance(record, Record):
                with suppress(ValueError):
                    self._take(record)

    def _take(self, record: Record) -> None:
        if record.kind == RecordKind.TOPIC:
            number, topic = decode_topic(record.payload)
            before = self.topics.get(topic.name)  # of a controller that was unloaded: numbers go on
            opened = LiveTopic(topic, before.count if before else 0)
            self.topics[topic.name] = self._by_number[number] = opened
        elif record.kind == RecordKind.MESSAGE:
            message = decode_message(record.payload)
            if (live := self._by_number.get(message.topic)) is not None:
                live.keep(message)


def events_after(events: deque[tuple[int, Event]], number: int | None) -> Messages:
    """Return events as messages of their topic."""
    last = events[-1][0] if events else 0
    begin = last if number is None else number + 1
    first = events[0][0] if events else 1
    start = max(0, begin - first)  # they are numbered without a gap
    chosen = list(islice(events, start, start + MOST_PER_ANSWER)) if begin <= last else []
    found = [Message(n, event.t_ns * 1e-9, _event(event)) for n, event in chosen]
    lost = 0 if number is None else max(0, first - number - 1)
    return Messages(EVENT_TOPIC, EVENT.name, (), (*found,), found[-1].number if found else last, lost)


def _event(event: Event) -> dict[str, object]:
    return {
        "t_ns": event.t_ns,
        "code": int(event.code),
        "severity": int(event.severity),
        "name": event.name,
        "source": event.source,
        "text": event.text,
        "data": event.data.decode(errors="replace"),
    }


def joint_states(record: CycleRecord | None, joints: tuple[str, ...], number: int | None) -> Messages:
    """Return the states of the newest cycle, as a message whose number is the cycle's, from 1."""
    found: list[Message] = []
    count = 0 if record is None else record.cycle + 1
    if record is not None and (number is None or count > number):
        states = record.states
        message = {
            "name": joints,
            "position": plain(states.position),
            "velocity": plain(states.velocity),
            "effort": plain(states.effort),
        }
        found.append(Message(count, record.woken_ns * 1e-9, message))
    return Messages(JOINT_STATES_TOPIC, JOINT_STATE.name, joints, (*found,), max(count, number or 0), 0)


def source_messages(record: CycleRecord | None, name: str, number: int | None) -> Messages | None:
    """Return the states of a source in the newest cycle, as `joint_states`; None: there is no such source."""
    state = None if record is None else source_state(record, name)
    if record is None or state is None:
        return None
    count = record.cycle + 1
    new = number is None or count > number
    found = [Message(count, record.woken_ns * 1e-9, state)] if new else []
    return Messages(f"/{name}", "states", (), (*found,), max(count, number or 0), 0)


def source_state(record: CycleRecord, name: str) -> dict[str, object] | None:
    """Return the states of a device, a sensor, or a controller that provides some, SI units; None: no such.

    `name`: its own, or that of one state, `imu/orientation.x`.
    """
    owner, _, state = name.partition("/")
    layout, sources = record.layout, record.sources
    if owner not in layout.sources:
        return None
    place, where = layout.sources.index(owner), layout.source_slice(owner)
    names = (each.partition("/")[2] for each in layout.source_states[where])
    values = {
        each: value if math.isfinite(value) else None
        for each, value in zip(names, sources.values[where].tolist(), strict=True)
        if state in ("", each)
    }
    age_ns = int(sources.age_ns[place])
    age = age_ns * 1e-9 if age_ns >= 0 else None
    return {"valid": bool(sources.valid[place]), "age": age, "states": values} if values else None


def _fields(message: Mapping[str, object]) -> dict[str, object]:
    return {name: plain(value) for name, value in message.items()}


def plain(value: object) -> object:
    """Return a value of a message as JSON has it; numbers that are none (NaN, infinite) become null."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return _fields(value)
    if isinstance(value, list):
        return [plain(one) for one in value]
    return value
