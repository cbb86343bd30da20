"""Runs without a fault on simulated buses in real time while the machine is busy: is anything accused?

    python -m bench.fault_free [--runs 60] [--seconds 5]

Three robots take turns, and so do four loads: none, a compile job in a loop, a program that keeps the core of
the loop busy, and both. Prints the verdict on each run, and a table; ends with 1 if a servo, a cable or an
adapter was accused in any.
"""

from __future__ import annotations

import argparse
import itertools
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from tests.analysis.verdicts.cases import HARDWARE, Case
from tests.analysis.verdicts.rig import ROBOTS, Story
from tests.kit.awaited import DEADLINE_S, until

NAMES = ("mx_two", "ax_single", "x_three")


KERNEL = Path(__file__).parents[1] / "runtime/dxlwire/exchange/kernel.c"
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


def idle(run: Run) -> str:
    """Leave the machine to the run."""
    run.wait(120)
    return "idle"


def compile_job(run: Run) -> str:
    """Compile beside it."""
    return compile_jobs(run, 1)


def both(run: Run) -> str:
    """Compile, and keep the loop's core busy."""
    with compiling(1):
        return hog_on_the_core_of_the_loop(run)


LOADS: dict[str, Callable[[Run], str]] = {
    "idle": idle,
    "compile job": compile_job,
    "pinned hog": hog_on_the_core_of_the_loop,
    "both": both,
}


def run_live(story: Story, load: Callable[[Run], str]) -> Path:
    """Run a robot in real time by the command line, with something beside it; return its log."""
    file, played = story.write_files()
    command = [str(Path(sys.executable).with_name("dxlrun")), str(file), "--no-gateway"]
    command += ["--duration", f"{story.duration_s:g}"]
    command += [word for motion in played for word in ("--play", str(motion))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            load(process)
            said, _ = process.communicate(timeout=DEADLINE_S)
        finally:
            process.kill()
    logs = list(story.directory.glob("*.mcap"))
    assert logs, said
    return logs[0]


def main() -> int:
    """Run them; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=5.0, help="of motion in each")
    options = parser.parse_args()
    counts: Counter[tuple[str, str]] = Counter()
    # three robots and four loads: each pair comes once in twelve runs
    turns = zip(range(options.runs), itertools.cycle(NAMES), itertools.cycle(LOADS), strict=False)
    for number, name, load in turns:
        began = time.monotonic()
        with tempfile.TemporaryDirectory() as directory:
            story = Story(ROBOTS[name], f"fault free {number}", Path(directory))
            story.duration_s = options.seconds + 2
            story.motion = story.swing()
            found = Case(load, (name,), spared=HARDWARE).compare(ROBOTS[name], run_live(story, LOADS[load]))
        counts[load, "runs"] += 1
        counts[load, "good"] += found.verdict.good
        counts[load, "accused"] += bool(found.accused)
        accused = f"; ACCUSED: {', '.join(found.accused)}" if found.accused else ""
        print(f"{number + 1} {name}, {load}: {found.verdict.word}{accused}", end=" ")
        print(f"[{time.monotonic() - began:.0f} s]", flush=True)
        for sentence in found.verdict.sentences[:2]:
            print(f"    {sentence}")
        for finding in found.verdict.findings if found.accused else ():
            print(f"    {finding.rank!r} {finding.subject!r}: {finding.sentence} -> {finding.remedy}")
    print(f"{'load':12} {'runs':>5} {'good':>5} {'accused':>8}")
    for load in LOADS:
        print(f"{load:12} {counts[load, 'runs']:5} {counts[load, 'good']:5} {counts[load, 'accused']:8}")
    return int(any(counts[load, "accused"] for load in LOADS))


if __name__ == "__main__":
    raise SystemExit(main())
