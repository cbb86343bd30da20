"""Cluster: tasks go to the workers of dask.distributed, on this machine or on others, and come back measured.

Each worker process has one run at a time. What dask does is dask's: a task whose worker is gone is run again,
and given up when it took several workers with it.
"""

from __future__ import annotations

import logging
import signal
import warnings
from collections.abc import Iterable, Iterator
from concurrent.futures import CancelledError, Executor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from time import monotonic

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, wait

from dxlrun.errors import ProcessFault
from dxlrun.experiments.sweep.measuring import Measured, OtherVersions, Task, measure

CONNECT_S = 5.0
"""For a cluster's first answer."""
NO_WORKERS_S = 30.0
"""A cluster that had no worker for so long is given up: workers may be replaced meanwhile."""
_POLL_S = 0.5
_LOST = "3s"
"""After which a worker on this machine that is gone makes room for another one."""
_CRASHES = 1
"""Of a task's processes on this machine, after which it is run once more."""


Result = Measured | OtherVersions


@dataclass(frozen=True, slots=True)
class Named:
    """A task and what its result is to be known by."""

    name: str
    task: Task


@contextmanager
def local_cluster(workers: int) -> Iterator[Client]:
    """Give a cluster of processes on this machine, which listens on the loopback interface alone."""
    settings = {
        "distributed.scheduler.allowed-failures": _CRASHES,
        "distributed.deploy.lost-worker-timeout": _LOST,
        "distributed.scheduler.http.routes": [],
        "distributed.worker.http.routes": [],
        "distributed.worker.profile.enabled": False,  # a thread that looks at every run, for the dashboard
    }
    with _silent(), dask.config.set(settings):
        with _without_interrupts():
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                host="127.0.0.1",
                dashboard_address=None,
                scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
                silence_logs=logging.CRITICAL,
            )
        with cluster, Client(cluster) as client:
            yield client


@contextmanager
def running_cluster(address: str) -> Iterator[Client]:
    """Give a cluster that runs; raises ProcessFault with one sentence when it cannot be reached."""
    with _silent():
        try:
            client = Client(address, timeout=CONNECT_S)
        except (OSError, ValueError) as error:
            raise ProcessFault(
                f"there is no Dask cluster at {address} ({_reason(error)}); `dask scheduler` starts one"
            ) from None
        try:
            yield client
        finally:
            with suppress(Exception):  # it may be gone
                client.close(timeout=2)


@contextmanager
def cluster_executor(address: str) -> Iterator[Executor]:
    """Give the workers of a cluster that runs, as an executor. Raises ProcessFault as running_cluster."""
    with running_cluster(address) as client:
        if not _threads(client):
            raise ProcessFault(f"the Dask cluster at {address} has no workers; `dask worker` starts one")
        yield client.get_executor()


def measured(client: Client, tasks: Iterable[Named]) -> Iterator[tuple[str, Measured]]:
    """Give each worker a task, and yield what comes back, in the order in which it does.

    Tasks are taken from `tasks` when a worker is free. Raises ProcessFault with one sentence when the cluster
    is gone, has no workers, or other versions.
    """
    waiting = iter(tasks)
    running: dict[Future[Result], str] = {}
    without_workers: float | None = None
    more = True
    try:
        while True:
            free = _threads(client)
            _replace_lost(client, free)
            while more and len(running) < free:
                named = next(waiting, None)
                if named is None:
                    more = False
                else:
                    running[client.submit(measure, named.task, key=f"dxlrun-{named.name}", pure=True)] = (
                        named.name
                    )
            if not running and not more:
                return
            without_workers = None if free else without_workers or monotonic()
            if without_workers is not None and monotonic() - without_workers > NO_WORKERS_S:
                raise ProcessFault(
                    f"the Dask cluster at {_address(client)} has no workers; `dask worker` starts one"
                )
            for future in _done(running):
                name = running.pop(future)
                yield name, _result(client, future)
                future.release()
    finally:
        for future in running:
            with suppress(Exception):  # the cluster may be gone
                future.cancel(force=True)


def _threads(client: Client) -> int:
    """Return how many tasks the workers can run at once."""
    try:
        return sum(client.nthreads().values())
    except (OSError, AttributeError) as error:
        raise _lost(client, error) from None


def _replace_lost(client: Client, workers: int) -> None:
    """Start a worker of this machine anew that is gone for good: one that ended while it was started."""
    cluster = client.cluster
    if isinstance(cluster, LocalCluster) and workers < len(cluster.worker_spec):
        cluster.scale(len(cluster.worker_spec))


def _done(running: dict[Future[Result], str]) -> list[Future[Result]]:
    """Return the tasks that have ended, after waiting a moment for one."""
    with suppress(TimeoutError, CancelledError):  # a future's status has it
        wait(list(running), timeout=_POLL_S, return_when="FIRST_COMPLETED")
    return [future for future in running if future.status != "pending"]


def _result(client: Client, future: Future[Result]) -> Measured:
    """Return what became of a task that has ended."""
    if future.status == "finished":
        try:
            result: Result = future.result(timeout=CONNECT_S)
        except (OSError, CancelledError) as error:
            raise _lost(client, error) from None
        if isinstance(result, OtherVersions):
            raise ProcessFault(
                f"a worker of the Dask cluster at {_address(client)} has {result.sentence}; "
                "install the same there"
            )
        return result
    raised: BaseException | None = future.exception() if future.status == "error" else None
    if isinstance(raised, KilledWorker):
        tries = raised.allowed_failures + 1
        times = "once" if tries == 1 else f"{tries} times"
        return Measured("crashed", f"its process ended {times}: it crashed, hung, or had too little memory")
    if raised is None:
        raise _lost(client, None)
    if isinstance(raised, ImportError) or "deserializ" in str(raised):
        raise ProcessFault(
            f"the Dask cluster at {_address(client)} cannot take the runs ({_reason(raised)}); "
            "install dxlrun and dask in the versions of this machine on its scheduler and workers"
        )
    return Measured("failed", _reason(raised))


def _lost(client: Client, error: BaseException | None) -> ProcessFault:
    reason = f" ({_reason(error)})" if error is not None and str(error) else ""
    return ProcessFault(f"the Dask cluster at {_address(client)} is gone{reason}")


def _address(client: Client) -> str:
    return str(client.scheduler.address) if client.scheduler is not None else "its address"


def _reason(error: BaseException) -> str:
    """Return the last cause of an error in one line."""
    while error.__cause__ is not None:
        error = error.__cause__
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Start threads and processes that never get a SIGINT: one from the terminal goes to all processes.

    They inherit the mask, and those that they start do too: also workers that dask starts anew later.
    """
    resource_tracker.ensure_running()  # which would take the mask away again where it is started later
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _silent() -> Iterator[None]:
    """Keep the log and the warnings of dask off the terminal: what matters is reported in our sentences."""
    for name in ("distributed", "tornado", *logging.root.manager.loggerDict):
        if name.startswith(("distributed", "tornado")):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="distributed")
        yield
