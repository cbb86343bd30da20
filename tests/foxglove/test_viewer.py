"""A viewer that is slow, or takes nothing: what waits for it does not grow."""

from __future__ import annotations

import asyncio
import json
from typing import Any, cast

from websockets.asyncio.server import ServerConnection

from dxlrun.log.schemas import CYCLE
from dxlrun_foxglove.foxglove_server import FoxgloveServer
from dxlrun_foxglove.viewer import MOST_BYTES, MOST_REPLIES, SLOW, Channel, Viewer

CHANNEL = Channel(3, "/cycle", CYCLE, latched=False)


class SlowConnection:
    """Takes a frame when it is let."""

    def __init__(self) -> None:
        self.taken: list[Any] = []
        self.aborted = 0
        self.transport = self
        self.let = asyncio.Semaphore(0)

    def abort(self) -> None:
        self.aborted += 1

    async def send(self, frame: str | bytes) -> None:
        await self.let.acquire()
        self.taken.append(frame)


def test_the_oldest_messages_are_left_out_for_a_slow_viewer() -> None:
    async def run() -> None:
        connection = SlowConnection()
        viewer = Viewer(cast("ServerConnection", connection))
        viewer.subscriptions[3] = 7
        most = MOST_BYTES // (1000 + 13)
        sending = asyncio.create_task(viewer.send_queued())
        for number in range(3 * most):
            viewer.queue_message(CHANNEL, number, b"x" * 1000)
        connection.let = asyncio.Semaphore(10**6)
        await asyncio.sleep(0)
        sending.cancel()
        sending = asyncio.create_task(viewer.send_queued())
        while len(connection.taken) < most + 1:
            await asyncio.sleep(0)
        await asyncio.sleep(0)
        sending.cancel()
        assert json.loads(connection.taken[0])["message"] == SLOW
        numbers = [int.from_bytes(frame[5:13], "little") for frame in connection.taken[1:]]
        assert numbers == list(range(2 * most, 3 * most))  # the newest, in order
        for number in range(3 * most):  # a second time, which is reported again
            viewer.queue_message(CHANNEL, number, b"x" * 1000)
        sending = asyncio.create_task(viewer.send_queued())
        while len(connection.taken) < 2 * most + 1:
            await asyncio.sleep(0)
        sending.cancel()
        assert json.loads(connection.taken[most + 1])["message"] == SLOW
        assert connection.aborted == 0

    asyncio.run(run())


def test_a_viewer_that_keeps_up_gets_every_message() -> None:
    async def run() -> None:
        connection = SlowConnection()
        connection.let = asyncio.Semaphore(10**6)
        viewer = Viewer(cast("ServerConnection", connection))
        viewer.subscriptions[3] = 7
        sending = asyncio.create_task(viewer.send_queued())
        data = bytes(MOST_BYTES // 4)
        for number in range(10):
            viewer.queue_message(CHANNEL, number, data)
            while len(connection.taken) <= number:
                await asyncio.sleep(0)
        sending.cancel()
        assert [frame for frame in connection.taken if isinstance(frame, str)] == [], "a warning"
        assert [int.from_bytes(frame[5:13], "little") for frame in connection.taken] == list(range(10))

    asyncio.run(run())


def test_a_closed_plot_ends_its_own_subscription() -> None:
    viewer = Viewer(cast("ServerConnection", SlowConnection()))
    viewer.subscriptions = {3: 7, 7: 3}
    server = FoxgloveServer("robot", (), control=False)
    server._process_frame(
        viewer, cast("Any", None), json.dumps({"op": "unsubscribe", "subscriptionIds": [7]})
    )
    assert viewer.subscriptions == {7: 3}


def test_a_viewer_that_takes_no_replies_is_gone() -> None:
    async def run() -> None:
        connection = SlowConnection()
        viewer = Viewer(cast("ServerConnection", connection))
        for _ in range(MOST_REPLIES):
            viewer.reply("{}")
        assert connection.aborted == 0
        viewer.reply("{}")
        assert connection.aborted == 1

    asyncio.run(run())


def test_what_it_has_not_subscribed_to_does_not_wait() -> None:
    async def run() -> None:
        connection = SlowConnection()
        viewer = Viewer(cast("ServerConnection", connection))
        viewer.queue_message(CHANNEL, 0, b"x")
        connection.let.release()
        sending = asyncio.create_task(viewer.send_queued())
        await asyncio.sleep(0)
        sending.cancel()
        assert not connection.taken

    asyncio.run(run())
