"""Viewer: one connection, and what waits to be sent on it, in memory that does not grow."""

from __future__ import annotations

import asyncio
from collections import deque

import msgspec
from websockets.asyncio.server import ServerConnection

from dxlrun.tooling.topics import MessageType
from dxlrun_foxglove.protocol import MESSAGE, MESSAGE_HEAD, WARNING, status

MOST_BYTES = 4 << 20
"""Of messages that wait for a slow viewer; of more the oldest are left out."""
MOST_REPLIES = 1000
"""Other frames that wait; a viewer that takes none of so many is gone."""
MOST_REQUESTS = 4
"""Of one viewer at once, halt beside them."""
SLOW = "Send buffer limit reached"
"""Lichtblick explains this sentence."""


class Channel(msgspec.Struct, eq=False):
    """A topic as viewers know it."""

    number: int
    topic: str
    type: MessageType
    latched: bool
    """A viewer that subscribes late gets its newest message."""
    newest: tuple[int, bytes] | None = None
    """Time, ns since 1970, and CDR; None: there was none, and viewers do not know the channel yet."""


class Viewer:
    """What one viewer has subscribed to, and what waits for it."""

    def __init__(self, connection: ServerConnection) -> None:
        self.connection = connection
        self.subscriptions: dict[int, int] = {}
        """Its own numbers of channels."""
        self.parameters: set[str] = set()
        self.graph = False
        self.requests: set[asyncio.Task[None]] = set()
        """Those that the robot has not answered yet."""
        self._replies: deque[str | bytes] = deque()
        self._messages: deque[bytes] = deque()
        self._bytes = 0
        self._slow = False
        self._more = asyncio.Event()

    def reply(self, frame: str | bytes) -> None:
        """Send a frame; they all come, in order."""
        if len(self._replies) == MOST_REPLIES:
            self.connection.transport.abort()
            return
        self._replies.append(frame)
        self._more.set()

    def show(self, channel: Channel, wall_ns: int, data: bytes) -> None:
        """Send a message, if the viewer has subscribed to it."""
        subscription = self.subscriptions.get(channel.number)
        if subscription is None:
            return
        self._messages.append(MESSAGE_HEAD.pack(MESSAGE, subscription, wall_ns) + data)
        self._bytes += len(self._messages[-1])
        while self._bytes > MOST_BYTES:
            self._bytes -= len(self._messages.popleft())
            if not self._slow:
                self._slow = True
                self.reply(status(WARNING, SLOW))
        self._more.set()

    async def send(self) -> None:
        """Send what waits, as fast as the viewer takes it. Raises ConnectionClosed."""
        while True:
            self._more.clear()
            while self._replies or self._messages:
                if self._replies:
                    frame = self._replies.popleft()
                else:
                    frame = self._messages.popleft()
                    self._bytes -= len(frame)
                await self.connection.send(frame)
            self._slow = False
            await self._more.wait()
