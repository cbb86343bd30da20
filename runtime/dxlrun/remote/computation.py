"""Computation: long work in a forked copy of the gateway's process, so that other clients are still served.

A fork costs a few milliseconds, and no data needs to be sent to it. The copy is killed at its timeout, even
in the middle of a call into C, and by Linux when the gateway dies (prctl(2), PR_SET_PDEATHSIG).
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
    """Return the bytes that `work` returns, computed in a forked process.

    Args:
        work: Function without side effects on this process.
        seconds: Timeout, s, after which the forked process is killed.

    Returns:
        None when `work` takes longer than the timeout, or raises.
    """
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

    def receive_chunk() -> None:
        content.extend(chunk := os.read(reading, _CHUNK))
        if not chunk and not ended.done():
            loop.remove_reader(reading)
            ended.set_result(None)

    loop.add_reader(reading, receive_chunk)
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
    """Run `work` in the forked process, write its result to the pipe and exit; never returns."""
    code = 1
    with suppress(BaseException):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        # Close the inherited sockets: otherwise the connections of clients and the run's socket stay open
        # after the gateway has closed them.
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
