"""Pools: processes on this machine, or the workers of a Dask cluster, behind `concurrent.futures.Executor`.

Processes of this machine are reached by pipes: nothing listens. A Dask worker runs whatever a program sends
that can connect, so a cluster is used only with TLS, where both ends show a certificate.
"""

from __future__ import annotations

import ctypes
import logging
import signal
import warnings
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import active_children, get_context, resource_tracker
from typing import TYPE_CHECKING

from dxlrun.errors import ProcessFault

if TYPE_CHECKING:
    from distributed import Client

CONNECT_S = 5.0
"""For a cluster's first answer."""
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
    """End with the process that started this one."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


@contextmanager
def cluster(address: str) -> Iterator[Client]:
    """Give a Dask cluster that runs, with workers. Raises ProcessFault with one sentence where there is none.

    Certificates are those of Dask's own configuration, `distributed.comm.tls`.
    """
    from dask import config
    from distributed import Client

    with _silent():
        if config.get("distributed.comm.tls.ca-file", None) is None:
            raise ProcessFault(
                f"--cluster {address} needs certificates, and Dask's configuration has no "
                "distributed.comm.tls.ca-file; see https://distributed.dask.org/en/latest/tls.html"
            )
        try:
            client = Client(address, timeout=CONNECT_S)
        except (OSError, ValueError) as error:
            raise ProcessFault(
                f"there is no Dask cluster at {address} ({_reason(error)}); `dask scheduler` starts one"
            ) from None
        try:
            if not client.nthreads():
                raise ProcessFault(f"the Dask cluster at {address} has no workers; `dask worker` starts one")
            yield client
        finally:
            with suppress(Exception):  # it may be gone
                client.close(timeout=2)


@contextmanager
def cluster_executor(address: str) -> Iterator[Executor]:
    """Give the workers of a cluster that runs. Raises ProcessFault as `cluster`."""
    with cluster(address) as client:
        yield client.get_executor()


def _reason(error: BaseException) -> str:
    """Return the last cause of an error in one line."""
    while error.__cause__ is not None:
        error = error.__cause__
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__


@contextmanager
def _silent() -> Iterator[None]:
    """Keep the log and the warnings of dask off the terminal: what matters is reported in our sentences."""
    for name in ("distributed", "tornado", *logging.root.manager.loggerDict):
        if name.startswith(("distributed", "tornado")):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="distributed")
        yield
