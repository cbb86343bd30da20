"""Workers: tasks of a sweep run in processes of this machine or of a cluster, and come back measured."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Protocol

from dxlrun.errors import ProcessFault
from dxlrun_analysis.season.pools import cluster, processes
from dxlrun_lab.sweep.measuring import Measured, OtherVersions, Task, measure

CRASHES = 2
"""Processes that a task may end before it is given up: the first may have been killed from outside."""

Result = Measured | OtherVersions


class Worker(Protocol):
    """Takes one task at a time."""

    def submit(self, task: Task) -> Future[Result]:
        """Start a task."""


@dataclass(frozen=True, slots=True)
class Named:
    """A task and what its result is to be known by."""

    name: str
    task: Task


class LocalWorker:
    """One process on this machine; another one is started where it ended."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self._process: Executor | None = None

    def submit(self, task: Task) -> Future[Result]:
        """Start a task in the process, and the process where there is none."""
        if self._process is not None:
            try:
                return self._process.submit(measure, task)
            except BrokenExecutor:
                pass
        self._process = self._stack.enter_context(processes(1))
        return self._process.submit(measure, task)


@dataclass(frozen=True, slots=True)
class ClusterWorker:
    """One of the workers of a cluster, whichever is free."""

    executor: Executor

    def submit(self, task: Task) -> Future[Result]:
        """Send a task."""
        return self.executor.submit(measure, task)


@contextmanager
def local_workers(count: int) -> Iterator[list[Worker]]:
    """Give workers that are processes on this machine."""
    with ExitStack() as stack:
        yield [LocalWorker(stack) for _ in range(count)]


@contextmanager
def cluster_workers(address: str) -> Iterator[list[Worker]]:
    """Give as many workers as a running cluster has threads. Raises ProcessFault as `pools.cluster`."""
    with cluster(address) as client:
        yield [ClusterWorker(client.get_executor(pure=True))] * sum(client.nthreads().values())


def measured(workers: Iterable[Worker], tasks: Iterable[Named]) -> Iterator[tuple[str, Measured]]:
    """Give each worker a task, and yield what comes back, in the order in which it does.

    Tasks are taken from `tasks` when a worker is free. Raises ProcessFault with one sentence when a cluster
    is gone, or has other versions.
    """
    waiting, free = iter(tasks), list(workers)
    running: dict[Future[Result], tuple[Named, Worker, int]] = {}
    while True:
        while free and (named := next(waiting, None)) is not None:
            worker = free.pop()
            running[worker.submit(named.task)] = named, worker, 1
        if not running:
            return
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            named, worker, tries = running.pop(future)
            try:
                result = _result(future)
            except BrokenExecutor:
                if tries < CRASHES:
                    running[worker.submit(named.task)] = named, worker, tries + 1
                    continue
                result = Measured(
                    "crashed", f"its process ended {tries} times: it crashed, hung, or had too little memory"
                )
            free.append(worker)
            yield named.name, result


def _result(future: Future[Result]) -> Measured:
    """Return what became of a task that has ended; raises BrokenExecutor where its process did."""
    try:
        result = future.result()
    except BrokenExecutor:
        raise
    except CancelledError:
        raise ProcessFault("the Dask cluster is gone; what was measured before is kept") from None
    except Exception as error:  # `measure` itself raises nothing: what carries it does
        if type(error).__name__ == "KilledWorker":  # of dask, which need not be installed
            return Measured("crashed", "its worker ended: it crashed, hung, or had too little memory")
        raise ProcessFault(
            f"the Dask cluster cannot take the runs ({error}); install dxlrun and dask in the versions of "
            "this machine on its scheduler and workers"
        ) from None
    if isinstance(result, OtherVersions):
        raise ProcessFault(f"a worker has {result.sentence}; install the same there")
    return result
