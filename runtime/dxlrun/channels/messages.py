"""Messages of topics: encoded where they are made, and handed on as they are, to the log and to clients.

A topic is announced once, with its definition, before its first message; its messages name it by the number
that it gets then, which is not used again: controllers that are loaded in the run announce topics, too. Each
message has its number among those of its topic's name, so a reader knows how many it missed.
"""

from __future__ import annotations

import msgspec

from dxlrun.channels.ring import RING_SECONDS, Appender, RecordKind, record_size
from dxlrun.messages.definition import MessageType

LONGEST_MESSAGE = 64 * 1024
"""Bytes of a message as CDR; a trajectory's state of a hundred joints is a fifth of it."""
LEAST_CAPACITY = 1 << 20
"""Bytes of a ring: for the topics of the runtime, and of controllers that are loaded in the run."""
MOST_CAPACITY = 64 << 20


class PublishedTopic(msgspec.Struct, frozen=True):
    """A topic that the loop publishes: its name, its type, and the joints that rows of its arrays are of."""

    name: str
    """`/CONTROLLER/TOPIC`, or `/goals` of the runtime."""
    type: MessageType
    joints: tuple[str, ...] = ()


class OpenedTopic(msgspec.Struct, frozen=True, array_like=True, tag_field="is", tag=3):
    """A topic that has messages from here on."""

    number: int
    """By which its messages name it, in the order of announcement."""
    before: int
    """How many messages its name has had."""
    topic: PublishedTopic


class TopicMessage(msgspec.Struct, frozen=True, array_like=True, tag_field="is", tag=4):
    """One message."""

    t_ns: int
    """Wake-up of the cycle that published it, ns of the run's clock."""
    topic: int
    """Its number."""
    number: int
    """Of the message among those of its topic's name, from 1."""
    data: bytes
    """CDR."""


class MessageSink:
    """Takes topics and their messages; never blocks, never raises. This one forgets them: there is no log."""

    __slots__ = ()

    def announce(self, topic: PublishedTopic) -> int:
        """Take a topic; return its number."""
        return 0

    def message(self, topic: int, t_ns: int, data: bytes) -> None:
        """Take one message of an announced topic, of LONGEST_MESSAGE at most."""


class MessageRing(MessageSink):
    """Appends topics and messages to a ring."""

    __slots__ = ("_counts", "_numbers", "_writer")

    def __init__(self, writer: Appender) -> None:
        self._writer = writer
        self._counts: list[int] = []
        """Messages so far, by the topic's number."""
        self._numbers: dict[str, int] = {}
        """Of each name the newest topic."""

    def announce(self, topic: PublishedTopic) -> int:
        """Append a topic; return its number. The messages of a name are counted on."""
        number, before = len(self._counts), self._numbers.get(topic.name)
        count = 0 if before is None else self._counts[before]
        self._counts.append(count)
        self._numbers[topic.name] = number
        opened = OpenedTopic(number, count, topic)
        self._writer.append(RecordKind.TAGGED, msgspec.msgpack.encode(opened))
        return number

    def message(self, topic: int, t_ns: int, data: bytes) -> None:
        """Append one message."""
        self._counts[topic] = number = self._counts[topic] + 1
        message = TopicMessage(t_ns, topic, number, data)
        self._writer.append(RecordKind.TAGGED, msgspec.msgpack.encode(message))


LONGEST_RECORD = LONGEST_MESSAGE + 64
"""Bytes of a record; a definition is shorter by far."""


def usual_message(joints: int) -> int:
    """Return about how many bytes a message has that is of so many joints: eight rows, and names."""
    return 256 + joints * (8 * 8 + 24)


def message_capacity(bytes_per_second: float) -> int:
    """Return how many bytes of a ring hold 10 s of messages, within LEAST_CAPACITY and MOST_CAPACITY."""
    wanted = RING_SECONDS * int(bytes_per_second) + 2 * record_size(LONGEST_RECORD)
    return -(-min(max(LEAST_CAPACITY, wanted), MOST_CAPACITY) // 8) * 8
