"""Pools: processes on this machine, reached by pipes: nothing listens."""

from __future__ import annotations

import ctypes
import os
import signal
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import active_children, get_context, resource_tracker

_PR_SET_PDEATHSIG = 1


@contextmanager
def processes(count: int) -> Iterator[Executor]:
    """Give processes on this machine, which are killed when the context is left, or this process is."""
    # spawn: threads of this process (Arrow's) are no good company for a fork
    pool = ProcessPoolExecutor(count, get_context("spawn"), initializer=_follow)
    before = set(active_children())
    resource_tracker.ensure_running()  # which would take the mask away again where it is started later
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        pool.submit(int)  # starts them, without a Ctrl-C: one from the terminal goes to all processes
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    try:
        yield pool
    except BaseException:
        for process in set(active_children()) - before:
            process.kill()  # in the middle of its work: nothing waits for its result
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _follow() -> None:
    """End with the process that started this one, and give way to others: a robot may run here."""
    os.nice(10)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
