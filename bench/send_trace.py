"""Trace: which Python functions one `send` runs in the client, and which in the gateway.

The client sends to a socket that answers at once; the gateway gets the same request by ASGI and hands it to a
loop that takes it from its mailbox. What a first command imports and looks up is not counted. `ours` are the
functions of dxlrun; the others are of the standard library and of what it is built on.

    PYTHONPATH=. python bench/send_trace.py
"""

from __future__ import annotations

import asyncio
import socket
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Coroutine, Generator
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

from tests.remote.conftest import Desk

import dxlrun
from dxlrun.remote.client import RemoteRobot
from dxlrun.remote.sockets import SocketLink

ROOT = str(Path(dxlrun.__file__).parent)
ANSWER = b'HTTP/1.1 200 OK\r\nContent-Length: 24\r\n\r\n{"done": true,"cycle":7}'
COMMAND = {"positions": [0.1]}
ROUNDS = 3
"""The last one counts."""

Calls = Counter[CodeType]


def counted(calls: Calls, work: Callable[[], object]) -> object:
    """Run some work, and count the Python functions that it enters."""

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            calls[frame.f_code] += 1

    sys.setprofile(note)
    try:
        return work()
    finally:
        sys.setprofile(None)


def client() -> Calls:
    """Return what a client runs."""
    calls: Calls = Counter()
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX) as listener:
        path = Path(folder, "s.sock")
        listener.bind(str(path))
        listener.listen()
        peer = threading.Thread(target=serve, args=(listener,), daemon=True)
        peer.start()
        with RemoteRobot("pair", SocketLink(path, "trace")) as robot:
            for _ in range(ROUNDS):
                calls.clear()
                counted(calls, lambda: robot.send("left", "go", COMMAND))
        peer.join()
    return calls


def serve(listener: socket.socket) -> None:
    """Answer every request of one connection."""
    with listener.accept()[0] as end:
        while end.recv(65536):
            end.sendall(ANSWER)


class Counted:
    """A coroutine of which only its own steps are counted, not what runs while it waits."""

    def __init__(self, calls: Calls, work: Coroutine[Any, Any, object]) -> None:
        self.calls, self.steps = calls, work

    def __await__(self) -> Generator[object, None, None]:
        while True:
            try:
                awaited = counted(self.calls, lambda: self.steps.send(None))
            except StopIteration:
                return
            yield awaited


def gateway() -> Calls:
    """Return what the gateway runs."""
    calls: Calls = Counter()
    desk = Desk()

    async def send() -> None:
        calls.clear()
        request = desk.request("POST", "/controllers/left/commands/go", COMMAND)
        asked = asyncio.ensure_future(awaited(Counted(calls, request)))
        while not asked.done():
            desk.take()
            desk.link.collect_messages()
            await asyncio.sleep(0)

    async def awaited(steps: Counted) -> None:
        await steps

    for _ in range(ROUNDS):
        asyncio.run(send())
    return calls


def main() -> None:
    """Print the functions by file."""
    for name, calls in (("client", client()), ("gateway", gateway())):
        ours = [code for code in calls if code.co_filename.startswith(ROOT)]
        for file in sorted({code.co_filename for code in ours}):
            names = sorted(code.co_qualname for code in ours if code.co_filename == file)
            sys.stdout.write(f"  {Path(file).relative_to(ROOT)}: {', '.join(names)}\n")
        sys.stdout.write(f"{name}: {len(ours)} functions of ours, {len(calls)} in all\n")


if __name__ == "__main__":
    main()
