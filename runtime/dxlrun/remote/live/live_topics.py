"""Live topics: messages of the loop's topics, of each cycle and of events, streamed to clients.

Each stream reads the loop's rings at its own pace, so a slow client neither delays the loop nor fills memory.
The rings hold about ten seconds. A client that is further behind misses messages, which shows as a gap in
their numbers.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import NamedTuple

import msgspec

from dxlrun.channels.cycle import CycleLayout, CycleRecord
from dxlrun.channels.event_records import Event
from dxlrun.channels.ring import Gap, Record, RingReader
from dxlrun.channels.tagged import Tagged, decode
from dxlrun.channels.topic_messages import OpenedTopic, PublishedTopic, TopicRecord
from dxlrun.log.schemas import CYCLE, EVENT, JOINT_STATE, LogTopic
from dxlrun.messages.cdr import ENCAPSULATION, Codec
from dxlrun.messages.definition import MessageType
from dxlrun.remote.requests.replies import FRAME_LENGTH, Frame, StreamMessage, StreamTopic, TopicState

MOST_RECORDS = 64
"""Upper limit of the records of each ring that a stream reads before the gateway serves other clients."""
_TIMES = 64
"""Number of recent messages from whose times a topic's rate is measured."""
SOURCE_STATES = MessageType(
    "dxlrun_msgs/msg/SourceStates",
    """# States of a device, a sensor, or a controller that provides some, SI units; NaN = not known.
# valid: this cycle brought them; age_ns: since they were true, -1: none ever came.
bool valid
int64 age_ns
string[] name
float64[] value
""",
)
_EVENT, _JOINT_STATE, _SOURCE = Codec(EVENT), Codec(JOINT_STATE), Codec(SOURCE_STATES)
_encode = msgspec.msgpack.Encoder().encode


class _CycleTopic(NamedTuple):
    """Topic that has one message for every cycle, with the function that makes it from a cycle's record."""

    type: MessageType
    joints: tuple[str, ...]
    pack: Callable[[CycleRecord], bytes]


class _LoopTopic:
    """A topic that the loop publishes, with its newest message and the times of recent messages."""

    __slots__ = ("count", "newest", "times", "topic")

    def __init__(self, topic: PublishedTopic, count: int) -> None:
        self.topic, self.count = topic, count
        self.newest: TopicRecord | None = None
        self.times: deque[int] = deque(maxlen=_TIMES)

    def record_message(self, message: TopicRecord) -> None:
        """Record a message as the topic's newest one."""
        self.newest, self.count = message, message.number
        self.times.append(message.t_ns)

    def state(self) -> TopicState:
        """Return name, type, number of messages and measured rate (Hz) of the topic."""
        rate = None
        if len(self.times) > 1 and (span_ns := self.times[-1] - self.times[0]) > 0:
            rate = (len(self.times) - 1) * 1e9 / span_ns
        return TopicState(self.topic.name, self.topic.type.name, self.topic.joints, self.count, rate)


class LiveTopics:
    """All topics of a run: those of the loop, /events, and those made from each cycle."""

    def __init__(
        self,
        messages: int,
        cycles: int,
        layout: CycleLayout,
        events: deque[tuple[int, Event]],
        epoch_offset_ns: int,
    ) -> None:
        self.rings = messages, cycles
        """File descriptors of the loop's ring of messages and ring of cycles."""
        self.layout, self.events, self.epoch_offset_ns = layout, events, epoch_offset_ns
        self.of_loop: dict[str, _LoopTopic] = {}
        self.by_number: dict[int, _LoopTopic] = {}
        self.of_cycles = {
            LogTopic.CYCLE: _CycleTopic(CYCLE, layout.joints, lambda record: ENCAPSULATION + record.raw),
            LogTopic.JOINT_STATES: _CycleTopic(JOINT_STATE, layout.joints, self._joint_states),
        } | {
            f"/{source}": _CycleTopic(SOURCE_STATES, (), partial(_source_states, source))
            for source in layout.sources
        }
        self.ring = RingReader(messages)

    def collect_messages(self) -> list[tuple[PublishedTopic, TopicRecord]]:
        """Read the loop's messages since the last call, update their topics, and return topic and message of
        each.
        """
        found = []
        for message in _decoded(iter(self.ring.read_record, None)):
            if isinstance(message, OpenedTopic):
                opened = _LoopTopic(message.topic, message.before)
                self.of_loop[message.topic.name] = self.by_number[message.number] = opened
            elif isinstance(message, TopicRecord) and message.topic in self.by_number:
                known = self.by_number[message.topic]
                known.record_message(message)
                found.append((known.topic, message))
        return found

    def described(self, name: str) -> PublishedTopic:
        """Return name, type and joints of a topic; raises KeyError for an unknown name."""
        if name in self.of_loop:
            return self.of_loop[name].topic
        if name == LogTopic.EVENT:
            return PublishedTopic(name, EVENT)
        return PublishedTopic(name, self.of_cycles[name].type, self.of_cycles[name].joints)

    def topic_states(self, cycles: int) -> list[TopicState]:
        """Return name, type, number of messages and rate of all topics; `cycles` is the number of cycles so
        far.
        """
        events = self.events[-1][0] if self.events else 0
        return [
            *(one.state() for one in self.of_loop.values()),
            TopicState(LogTopic.EVENT, EVENT.name, (), events, None),
            *(
                TopicState(name, one.type.name, one.joints, cycles, None)
                for name, one in self.of_cycles.items()
            ),
        ]

    def _joint_states(self, record: CycleRecord) -> bytes:
        states = record.states
        stamp = divmod(max(0, record.woken_ns + self.epoch_offset_ns), 1_000_000_000)
        return _JOINT_STATE.pack(
            (stamp, ""), self.layout.joints, states.position, states.velocity, states.effort
        )


def _decoded(records: Iterable[Record | Gap]) -> Iterator[Tagged]:
    """Yield the decoded messages of a ring's records; lost and malformed records are skipped."""
    for record in records:
        if isinstance(record, Record):
            with suppress(ValueError):
                yield decode(record.payload)


def _source_states(source: str, record: CycleRecord) -> bytes:
    layout, sources = record.layout, record.sources
    place, where = layout.sources.index(source), layout.source_slice(source)
    names = tuple(name.partition("/")[2] for name in layout.source_states[where])
    valid, age_ns = bool(sources.valid[place]), int(sources.age_ns[place])
    return _SOURCE.pack(valid, age_ns, names, sources.values[where])


class TopicStream:
    """Frames of some topics for one client, from the newest message on; with `newest`, older ones are
    skipped.
    """

    def __init__(self, topics: LiveTopics, names: Sequence[str], *, newest: bool) -> None:
        self.behind = False
        """True when the last call left records unread because of MOST_RECORDS."""
        self._places = {name: place for place, name in enumerate(dict.fromkeys(names))}
        self._newest, self._events, self._offset_ns = newest, topics.events, topics.epoch_offset_ns
        self._first = [self._opened(topics.described(name)) for name in self._places]
        of_loop = [one for name, one in topics.of_loop.items() if name in self._places]
        self._numbers = {
            number: self._places[one.topic.name] for number, one in topics.by_number.items() if one in of_loop
        }
        self._first += (self._sample(one.newest) for one in of_loop if one.newest is not None)
        messages, cycles = topics.rings
        self._messages = RingReader(messages) if of_loop else None
        if self._messages is not None:
            self._messages.position = topics.ring.position
        packers = ((place, topics.of_cycles.get(name)) for name, place in self._places.items())
        self._packers = [(place, one.pack) for place, one in packers if one is not None]
        self._cycles = RingReader(cycles) if self._packers else None
        self._record = CycleRecord(topics.layout)
        self._event = self._events[-1][0] - 1 if self._events else 0

    def frames(self) -> bytes:
        """Return the encoded frames since the last call, from at most MOST_RECORDS records of each ring."""
        self.behind = False
        found = [*self._first, *self._new_messages(), *self._new_cycles(), *self._new_events()]
        self._first = []
        # Keep the last message of each topic.
        if self._newest:
            found = [*{(type(frame), frame.place): frame for frame in found}.values()]
        return b"".join(map(framed, found))

    def _opened(self, topic: PublishedTopic) -> StreamTopic | StreamMessage:
        place, kind = self._places[topic.name], topic.type
        return StreamTopic(place, topic.name, kind.name, kind.text, topic.joints, self._offset_ns)

    def _sample(self, message: TopicRecord) -> StreamTopic | StreamMessage:
        return StreamMessage(self._numbers[message.topic], message.number, message.t_ns, message.data)

    def _records(self, ring: RingReader) -> Iterator[Record]:
        for _ in range(MOST_RECORDS):
            if (record := ring.read_record()) is None:
                return
            if isinstance(record, Record):
                yield record
        self.behind = True

    def _new_messages(self) -> Iterator[StreamTopic | StreamMessage]:
        for message in _decoded(self._records(self._messages)) if self._messages is not None else ():
            if isinstance(message, OpenedTopic) and message.topic.name in self._places:
                self._numbers[message.number] = self._places[message.topic.name]
                yield self._opened(message.topic)
            elif isinstance(message, TopicRecord) and message.topic in self._numbers:
                yield self._sample(message)

    def _new_cycles(self) -> Iterator[StreamTopic | StreamMessage]:
        ring = self._cycles
        if ring is None:
            return
        newest = ring.newest() if self._newest or not ring.position else None
        for record in (newest,) if newest else () if self._newest else self._records(ring):
            if len(record.payload) == len(self._record.raw):
                self._record.raw[:] = record.payload
                # The first record shows the state before the first cycle.
                number = ring.passed - 1
                for place, pack in self._packers if number else ():
                    yield StreamMessage(place, number, self._record.woken_ns, pack(self._record))

    def _new_events(self) -> Iterator[StreamTopic | StreamMessage]:
        if LogTopic.EVENT not in self._places or not self._events or self._events[-1][0] <= self._event:
            return
        for number, event in self._events:
            if number > self._event:
                data = event.data.decode(errors="replace")
                texts = event.name, event.source, event.text, data
                packed = _EVENT.pack(event.t_ns, int(event.code), int(event.severity), 0, *texts)
                yield StreamMessage(self._places[LogTopic.EVENT], number, event.t_ns, packed)
        self._event = self._events[-1][0]


def framed(frame: Frame) -> bytes:
    """Return a frame as MessagePack, preceded by its length."""
    data = _encode(frame)
    return FRAME_LENGTH.pack(len(data)) + data
