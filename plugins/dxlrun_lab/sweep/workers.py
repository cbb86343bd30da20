"""Workers: processes of this machine, each of which runs one task of a sweep after the other."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import ExitStack, contextmanager

from dxlrun_analysis.season.pools import processes
from dxlrun_lab.sweep.measuring import Measured, Task, measure

CRASHES = 2
"""Processes that a task may end before it is given up: the first may have been killed from outside."""


class Worker:
    """One process, which takes one task at a time; another one is started where it ended."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self._process: Executor | None = None

    def submit(self, task: Task) -> Future[Measured]:
        """Start a task in the process, and the process where there is none."""
        if self._process is not None:
            try:
                return self._process.submit(measure, task)
            except BrokenExecutor:
                pass
        self._process = self._stack.enter_context(processes(1))
        return self._process.submit(measure, task)


@contextmanager
def workers(count: int) -> Iterator[list[Worker]]:
    """Give workers; their processes end with the context."""
    with ExitStack() as stack:
        yield [Worker(stack) for _ in range(count)]


def measured(workers: Iterable[Worker], tasks: Iterator[Task]) -> Iterator[tuple[str, Measured]]:
    """Give each worker a task, and yield each run with its result, in the order in which they come.

    Tasks are taken from `tasks` when a worker is free.
    """
    free = list(workers)
    running: dict[Future[Measured], tuple[Task, Worker, int]] = {}
    while True:
        while free and (task := next(tasks, None)) is not None:
            worker = free.pop()
            running[worker.submit(task)] = task, worker, 1
        if not running:
            return
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            task, worker, tries = running.pop(future)
            try:
                result = future.result()
            except BrokenExecutor:
                if tries < CRASHES:
                    running[worker.submit(task)] = task, worker, tries + 1
                    continue
                result = Measured(
                    "crashed", f"its process ended {tries} times: it crashed, hung, or had too little memory"
                )
            free.append(worker)
            yield task.run, result
