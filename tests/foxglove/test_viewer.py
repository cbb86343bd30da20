"""A viewer that is slow, or takes nothing: what waits for it does not grow."""

import asyncio
import json
from collections.abc import Callable
from typing import Any, cast

from websockets.asyncio.server import ServerConnection

from dxlrun.log.schemas import CYCLE
from dxlrun_foxglove.foxglove_server import FoxgloveServer
from dxlrun_foxglove.viewer import MOST_BYTES, MOST_REPLIES, SLOW, Channel, Viewer

CHANNEL = Channel(3, "/cycle", CYCLE, latched=False)


class SlowConnection:
    """Takes a frame when it is let."""

    def __init__(self, let: int = 0) -> None:
        self.taken: list[Any] = []
        self.aborted = 0
        self.transport = self
        self.let = asyncio.Semaphore(let)
        self.viewer = Viewer(cast("ServerConnection", self))

    def abort(self) -> None:
        self.aborted += 1

    async def send(self, frame: str | bytes) -> None:
        await self.let.acquire()
        self.taken.append(frame)

    async def take_until(self, is_done: Callable[[], bool] = lambda: True) -> None:
        """Let the viewer send until something is so."""
        sending = asyncio.create_task(self.viewer.send_queued())
        await asyncio.sleep(0)
        while not is_done():
            await asyncio.sleep(0)
        sending.cancel()


def test_the_oldest_messages_are_left_out_for_a_slow_viewer():
    async def run() -> None:
        connection, most = SlowConnection(10**6), MOST_BYTES // (1000 + 13)
        connection.viewer.subscriptions[3] = 7
        for count in (most + 1, 2 * (most + 1)):  # a second time, which is reported again
            for number in range(3 * most):
                connection.viewer.queue_message(CHANNEL, number, b"x" * 1000)
            await connection.take_until(lambda count=count: len(connection.taken) >= count)
            slow, *newest = connection.taken[-most - 1 :]
            assert json.loads(slow)["message"] == SLOW
            numbers = [int.from_bytes(frame[5:13], "little") for frame in newest]
            assert numbers == list(range(2 * most, 3 * most)), "in order"
        assert connection.aborted == 0

    asyncio.run(run())


def test_a_viewer_that_keeps_up_gets_every_message():
    async def run() -> None:
        connection = SlowConnection(10**6)
        connection.viewer.subscriptions[3] = 7
        for number in range(10):
            connection.viewer.queue_message(CHANNEL, number, bytes(MOST_BYTES // 4))
            await connection.take_until(lambda number=number: len(connection.taken) > number)
        assert [frame for frame in connection.taken if isinstance(frame, str)] == [], "a warning"
        assert [int.from_bytes(frame[5:13], "little") for frame in connection.taken] == list(range(10))

    asyncio.run(run())


def test_a_closed_plot_ends_its_own_subscription():
    viewer, server = SlowConnection().viewer, FoxgloveServer("robot", (), control=False)
    viewer.subscriptions = {3: 7, 7: 3}
    server._process_frame(viewer, cast("Any", None), '{"op": "unsubscribe", "subscriptionIds": [7]}')
    assert viewer.subscriptions == {7: 3}


def test_a_viewer_that_takes_no_replies_is_gone():
    async def run() -> None:
        connection = SlowConnection()
        for count in (MOST_REPLIES, 1):
            assert connection.aborted == 0
            for _ in range(count):
                connection.viewer.reply("{}")
        assert connection.aborted == 1

    asyncio.run(run())


def test_what_it_has_not_subscribed_to_does_not_wait():
    async def run() -> None:
        connection = SlowConnection(1)
        connection.viewer.queue_message(CHANNEL, 0, b"x")
        await connection.take_until()
        assert not connection.taken

    asyncio.run(run())
