"""Viewer: one WebSocket connection of Foxglove or Lichtblick, with its send queues of bounded size."""

from __future__ import annotations

import asyncio
from collections import deque

import msgspec
from websockets.asyncio.server import ServerConnection

from dxlrun.tooling.topics import MessageType
from dxlrun_foxglove.protocol import MESSAGE, MESSAGE_HEAD, WARNING, status

MOST_BYTES = 4 << 20
"""Largest size of a viewer's queue of messages, bytes. Beyond it, the oldest messages are dropped."""
MOST_REPLIES = 1000
"""Largest number of other queued frames. A viewer that lets more of them pile up is disconnected."""
MOST_REQUESTS = 4
"""Simultaneous requests of one viewer. A halt is accepted up to twice this number."""
SLOW = "Send buffer limit reached"
"""Warning to a slow viewer. Lichtblick shows an explanation for exactly this sentence."""


class Channel(msgspec.Struct, eq=False):
    """Topic of the robot's run under the number by which it is announced to viewers."""

    number: int
    topic: str
    type: MessageType
    latched: bool
    """True if a viewer that subscribes late receives the newest message at once."""
    newest: tuple[int, bytes] | None = None
    """Newest message: time (ns since 1970) and CDR; None before the first."""


class Viewer:
    """Connection of one viewer: its subscriptions, and queues of the frames to send."""

    def __init__(self, connection: ServerConnection) -> None:
        self.connection = connection
        self.subscriptions: dict[int, int] = {}
        """The viewer's own subscription number by number of the channel."""
        self.parameters: set[str] = set()
        """Parameters whose changes the viewer receives."""
        self.graph = False
        """True if the viewer receives the graph of publishers."""
        self.requests: set[asyncio.Task[None]] = set()
        """Tasks of the requests that the robot has not answered yet."""
        self._replies: deque[str | bytes] = deque()
        self._messages: deque[bytes] = deque()
        self._bytes = 0
        self._slow = False
        self._more = asyncio.Event()

    def reply(self, frame: str | bytes) -> None:
        """Queue a frame that is not a message. The viewer is disconnected if there are too many."""
        if len(self._replies) == MOST_REPLIES:
            # A regular close would wait for a viewer that does not receive.
            self.connection.transport.abort()
            return
        self._replies.append(frame)
        self._more.set()

    def queue_message(self, channel: Channel, wall_ns: int, data: bytes) -> None:
        """Queue a message (CDR; time in ns since 1970) if the viewer has subscribed to its channel.

        A slow viewer loses the oldest messages and gets one warning.
        """
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

    async def send_queued(self) -> None:
        """Send queued frames, replies before messages, as fast as the viewer receives them.

        Returns never; raises ConnectionClosed when the viewer has disconnected.
        """
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
