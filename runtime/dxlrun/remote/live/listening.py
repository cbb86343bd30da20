"""Listening: a client's iterator over the messages of a running robot's topics, blocking or with asyncio."""

from __future__ import annotations

import select
import socket
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import suppress
from functools import lru_cache
from typing import TYPE_CHECKING

import msgspec

from dxlrun.errors import DxlrunError
from dxlrun.remote.requests.replies import FRAME_LENGTH, Frame, StreamMessage, StreamTopic
from dxlrun.remote.sockets import TIMEOUT_S, RobotLink

if TYPE_CHECKING:
    from dxlrun.messages.cdr import Codec, Value

_CHUNK = 1 << 18
_decode = msgspec.msgpack.Decoder(Frame).decode


class TopicMessage(msgspec.Struct, frozen=True):
    """A message of a topic as a client received it, still encoded."""

    topic: str
    type: str
    """Name of the message type in ROS 2 format: `nav_msgs/msg/Odometry`."""
    number: int
    """Sequence number within the topic, counted from 1 by the robot."""
    time_ns: int
    """Time of the message, ns of the run's clock."""
    wall_ns: int
    """Time of the message as wall time, ns since 1970."""
    lost: int
    """Number of messages of the topic that were missed since the previous one this client received."""
    data: bytes
    """Content of the message, encoded as CDR (little-endian)."""
    definition: str
    """Definition of the message type in ROS 2 format (`ros2msg`)."""
    joints: tuple[str, ...] = ()
    """Joints of the rows of the message's arrays; empty: the arrays have no rows of joints."""

    @property
    def message(self) -> Mapping[str, Value]:
        """Fields of the message: sequences of numbers are arrays, nested messages are mappings.

        The message is decoded at each access.
        """
        return _codec(self.type, self.definition).unpack(self.data)


@lru_cache
def _codec(kind: str, definition: str) -> Codec:
    # Imported here because it imports NumPy, which most clients do not need.
    from dxlrun.messages.cdr import Codec
    from dxlrun.messages.definition import MessageType

    return Codec(MessageType(kind, definition))


class MessageIterator:
    """Iterator over messages, from the newest one until the end of the run; then the connection is closed.

    `for` and `async for` both work. A stream of `newest` messages skips older messages when this client is
    slower than the robot; `lost` counts them. Raises DxlrunError when the gateway is gone before the run has
    ended.
    """

    def __init__(self, name: str, link: RobotLink, end: socket.socket, first: bytes, *, newest: bool) -> None:
        self._name, self._link, self._end, self._newest = name, link, end, newest
        end.setblocking(False)
        self._bytes = bytearray(first)
        self._topics: dict[int, StreamTopic] = {}
        self._last: dict[int, int] = {}
        """Topic's number in the stream -> sequence number of its newest received message."""
        self._ended = False

    def __enter__(self) -> MessageIterator:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection, which ends the stream."""
        self._end.close()

    def __iter__(self) -> Iterator[TopicMessage]:
        look = select.poll()
        look.register(self._end, select.POLLIN)
        try:
            while not self._ended:
                yield from self._arrived()
                if not self._ended and not look.poll(TIMEOUT_S * 1e3):
                    raise self._gone(f"no data for {TIMEOUT_S:g} s")
        finally:
            self.close()

    async def __aiter__(self) -> AsyncIterator[TopicMessage]:
        # Imported here because most clients do not use asyncio.
        import asyncio

        receive = asyncio.get_running_loop().sock_recv
        try:
            while not self._ended:
                for message in self._arrived():
                    yield message
                if not self._ended:
                    # A reset connection yields no more bytes, which `_arrived` detects.
                    with suppress(ConnectionError):
                        async with asyncio.timeout(TIMEOUT_S):
                            self._bytes += await receive(self._end, _CHUNK)
        except TimeoutError:
            raise self._gone(f"no data for {TIMEOUT_S:g} s") from None
        finally:
            self.close()

    def _arrived(self) -> Iterator[TopicMessage]:
        """Yield the messages received since the last call, without waiting; only the newest of each topic if
        asked.

        Raises DxlrunError when the connection was closed and the run has not ended.
        """
        closed = False
        with suppress(BlockingIOError):
            # A stream of all messages reads the rest later.
            while (more := self._received()) and self._newest:
                pass
            closed = not more
        samples = self._samples()
        if self._newest:
            samples = [*{sample.place: sample for sample in samples}.values()]
        for sample in samples:
            topic, last = self._topics[sample.place], self._last.get(sample.place, sample.number - 1)
            self._last[sample.place] = sample.number
            yield TopicMessage(
                topic.name,
                topic.type,
                sample.number,
                sample.time_ns,
                sample.time_ns + topic.epoch_offset_ns,
                sample.number - last - 1,
                sample.data,
                topic.definition,
                topic.joints,
            )
        if closed and not self._ended:
            if not self._link.ends():
                raise self._gone("the connection was closed")
            self._ended = True

    def _received(self) -> bytes:
        """Receive available bytes into the buffer and return them; empty when the connection is closed."""
        try:
            more = self._end.recv(_CHUNK)
        except ConnectionError:
            return b""
        self._bytes += more
        return more

    def _samples(self) -> list[StreamMessage]:
        """Remove and return the complete messages in the buffer; note new topics and the end of the run."""
        found, at = [], 0
        while len(self._bytes) - at >= FRAME_LENGTH.size:
            begin = at + FRAME_LENGTH.size
            end = begin + FRAME_LENGTH.unpack_from(self._bytes, at)[0]
            if end > len(self._bytes):
                break
            if end > begin:
                frame = _decode(self._bytes[begin:end])
                if isinstance(frame, StreamTopic):
                    self._topics[frame.place] = frame
                elif isinstance(frame, StreamMessage):
                    found.append(frame)
                else:
                    self._ended = True
            at = end
        del self._bytes[:at]
        return found

    def _gone(self, why: str) -> DxlrunError:
        return DxlrunError(f"{self._name} no longer answers: {why}")
