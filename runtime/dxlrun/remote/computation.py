"""Computation: what may take seconds, in a copy of the gateway's process, so that other clients are served.

A copy costs a few milliseconds and needs nothing sent to it. It is killed when its time is over, also in
the middle of a call into C, and by Linux when the gateway dies (prctl(2), PR_SET_PDEATHSIG).
"""

from __future__ import annotations

import asyncio
import ctypes
import os
import signal
import stat
import traceback
from collections.abc import Callable
from contextlib import suppress

PR_SET_PDEATHSIG = 1
_CHUNK = 1 << 16


async def computed(work: Callable[[], bytes], seconds: float) -> bytes | None:
    """Return what `work` returns, computed elsewhere; None when it takes longer than that, or raises."""
    reading, writing = os.pipe()
    try:
        child = os.fork()
    except OSError:
        os.close(reading)
        os.close(writing)
        raise
    if child == 0:
        _compute(work, writing)
    os.close(writing)
    loop, content = asyncio.get_running_loop(), bytearray()
    ended: asyncio.Future[None] = loop.create_future()

    def receive() -> None:
        content.extend(chunk := os.read(reading, _CHUNK))
        if not chunk and not ended.done():
            loop.remove_reader(reading)
            ended.set_result(None)

    loop.add_reader(reading, receive)
    timer = loop.call_later(seconds, os.kill, child, signal.SIGKILL)
    try:
        await ended
    finally:
        timer.cancel()
        loop.remove_reader(reading)
        os.close(reading)
        if not ended.done() or ended.cancelled():
            os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
    return bytes(content) if os.waitstatus_to_exitcode(status) == 0 else None


def _compute(work: Callable[[], bytes], writing: int) -> None:
    """Do the work in the copy, and end it: it never returns to the gateway's own code."""
    code = 1
    with suppress(BaseException):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        # the connections of clients, and the socket by which the run is found, are the gateway's alone
        for descriptor in map(int, os.listdir("/proc/self/fd")):
            with suppress(OSError):
                if stat.S_ISSOCK(os.fstat(descriptor).st_mode):
                    os.close(descriptor)
        try:
            content = memoryview(work())
            while content:
                content = content[os.write(writing, content) :]
            code = 0
        except BaseException:
            traceback.print_exc()
    os._exit(code)
