"""A server of viewers in this process, as `dxlrun foxglove` has one in its own."""

import asyncio
import ssl
import threading
from concurrent.futures import Future

from dxlrun.remote.network.listener import Listener
from dxlrun_foxglove.foxglove_server import FoxgloveServer

PAGE = "https://app.foxglove.dev"


class Served:
    """It listens until it is closed."""

    def __init__(self, name: str, *, control: bool = False, tls: ssl.SSLContext | None = None) -> None:
        self.server = FoxgloveServer(name, (PAGE,), control=control)
        self._tls = tls
        self._loop = asyncio.new_event_loop()
        self._ended = asyncio.Event()
        begun: Future[int] = Future()
        self._thread = threading.Thread(target=self._loop.run_until_complete, args=[self._serve(begun)])
        self._thread.start()
        self.port = begun.result()

    async def _serve(self, begun: Future[int]) -> None:
        listener = Listener("127.0.0.1", 0)
        async with await self.server.accept_viewers(listener, self._tls):
            begun.set_result(listener.getsockname()[1])
            await self._ended.wait()
        await self._loop.shutdown_default_executor()

    @property
    def url(self) -> str:
        return self.address(self.server.token)

    def address(self, token: str) -> str:
        return f"{'wss' if self._tls else 'ws'}://127.0.0.1:{self.port}/?token={token}"

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join()
        self._loop.close()
