"""What keeps a machine busy while a robot runs on it in real time."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from tests.kit.awaited import DEADLINE_S, until

KERNEL = Path(__file__).parents[3] / "runtime/dxlwire/exchange/kernel.c"
_COMPILE = "while cc -O3 -g -fPIC -Wall -c {kernel} -o {out}; do :; done"
_HOG = "while True: pass"

Run = subprocess.Popen[str]


def descendants(pid: int) -> Iterator[tuple[int, str]]:
    """Return the processes below one, each with its command line."""
    parents = {}
    for place in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(place.name)] = int((place / "stat").read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    below = [pid]
    for one in below:
        below += [child for child, parent in parents.items() if parent == one]
    for one in below[1:]:
        try:
            yield one, (Path(f"/proc/{one}/cmdline").read_bytes().replace(b"\0", b" ").decode())
        except OSError:
            continue


def process_of(run: Run, what: str) -> int:
    """Return the process of a run with a word in its command line, once it is there; 0: the run is over."""

    def found() -> list[int]:
        pids = [pid for pid, words in descendants(run.pid) if what in words]
        return pids or ([] if run.poll() is None else [0])

    return until(found, what)[0]


@contextmanager
def compiling(count: int) -> Iterator[None]:
    """Compile the kernel again and again, in several processes."""
    with ExitStack() as stack:
        directory = stack.enter_context(tempfile.TemporaryDirectory())
        for number in range(count):
            words = ["sh", "-c", _COMPILE.format(kernel=KERNEL, out=f"{directory}/{number}.o")]
            stack.enter_context(_running(words))
        yield


@contextmanager
def hogging(core: int) -> Iterator[None]:
    """Keep one core busy."""
    with _running([sys.executable, "-c", f"import os; os.sched_setaffinity(0, {{{core}}})\n{_HOG}"]):
        yield


@contextmanager
def _running(words: list[str]) -> Iterator[None]:
    with subprocess.Popen(words, start_new_session=True, stderr=subprocess.DEVNULL) as process:
        try:
            yield
        finally:
            assert process.poll() is None, "it ended by itself"
            os.killpg(process.pid, signal.SIGKILL)


def core_of(pid: int) -> int:
    """Return on which core a process runs."""
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[36])


def compile_jobs(run: Run, count: int) -> str:
    """Compile beside a run until it is over."""
    with compiling(count):
        run.wait(DEADLINE_S)
    return "compiled"


def hog_on_the_core_of_the_loop(run: Run) -> str:
    """Keep the core busy on which the loop of a run is, as long as it runs."""
    loop = process_of(run, "loop_process")
    assert loop, "there is no loop"
    time.sleep(1.0)
    with hogging(core_of(loop)):
        run.wait(DEADLINE_S)
    return "hogged"
