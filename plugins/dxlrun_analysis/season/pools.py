"""Pool of processes that analyze logs in parallel, connected by pipes without a listening socket."""

from __future__ import annotations

import ctypes
import os
import signal
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import active_children, get_context, resource_tracker

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


@contextmanager
def processes(count: int) -> Iterator[Executor]:
    """Yield a pool of `count` processes. They are killed when the context is left with an error, or this
    process exits."""
    # Do not fork: Arrow has threads in this process, and a forked child could deadlock on their locks.
    pool = ProcessPoolExecutor(count, get_context("spawn"), initializer=_follow)
    before = set(active_children())
    resource_tracker.ensure_running()  # Started later, the tracker would reset the signal mask
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        # Start the processes with SIGINT blocked: Ctrl-C at a terminal goes to all processes.
        pool.submit(int)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    try:
        yield pool
    except BaseException:
        for process in set(active_children()) - before:
            process.kill()  # Interrupt the work: its result is not needed
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _follow() -> None:
    """Initialize a process of the pool: it exits with its parent, and has low priority because a robot may
    run on this machine."""
    os.nice(10)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
