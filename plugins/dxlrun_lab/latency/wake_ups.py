"""The measuring process: waits for one deadline after the other with the clock and the pacing of the loop.

It is executed and prepared as the loop's process is (one thread, real-time settings, the margin measured),
and waits on the same clock; between two waits it does nothing but write down the times. For the yardstick it
prepares itself in the same way and then becomes the program in C, which keeps policy, priority, cores and
timer slack (execve(2), prctl(2)); only locked memory is lost and asked for again there.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time

import msgspec

from dxlrun.tooling import realtime
from dxlrun.tooling.plans import SchedulerPlan
from dxlrun.tooling.realtime import Deadlines, store
from dxlrun_lab.latency.buffer import Buffer, Place

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class Job(msgspec.Struct, frozen=True):
    """What one process measures; JSON on its command line."""

    parent: int
    """Process ID: this process ends with it."""
    scheduler: SchedulerPlan
    period_ns: int
    iterations: int
    """0: ask for the settings, report what was granted, and end."""
    buffer: int
    """Descriptor of the shared memory."""
    grants: int
    """Descriptor of a nameless file for what the operating system granted."""
    yardstick: str = ""
    """Path of the program in C; empty: wait as the loop does."""


def measure(deadlines: Deadlines, iterations: int, buffer: Buffer) -> None:
    """Wait for so many deadlines, or until the front process asks for the end, and note both times."""
    words = buffer.words
    done, stop = int(Place.DONE), int(Place.STOP)  # plain integers: members of an enum are slower
    place = int(Place.WAKE_UPS)
    for number in range(1, iterations + 1):
        words[place], words[place + 1] = deadlines.wait()
        place += 2
        store(words, done, number)  # both times are seen before it
        if words[stop]:
            return


def run(job: Job) -> None:
    """Prepare this process, measure, and leave the times it took in the buffer."""
    buffer = Buffer(job.buffer)
    grants = realtime.apply(job.scheduler)
    deadlines = Deadlines(job.period_ns)
    if job.iterations and not job.yardstick:
        grants = (*grants, deadlines.measure_margin(job.scheduler.polling_ns))
        buffer.words[Place.MARGIN_NS] = deadlines.margin_ns
    os.pwrite(job.grants, msgspec.json.encode(grants), 0)
    if job.yardstick:
        words = (job.buffer, job.iterations, job.period_ns, int(job.scheduler.lock_memory))
        os.execv(job.yardstick, ("yardstick", *map(str, words)))  # noqa: S606  compiled a moment ago
    if not job.iterations:
        return
    buffer.touch()
    begin_cpu_ns, begin_ns = time.process_time_ns(), time.monotonic_ns()
    measure(deadlines, job.iterations, buffer)
    buffer.words[Place.CPU_NS] = time.process_time_ns() - begin_cpu_ns
    buffer.words[Place.WALL_NS] = time.monotonic_ns() - begin_ns


def main() -> None:
    """Be a measuring process: `JOB-AS-JSON`."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    job = msgspec.json.decode(sys.argv[1], type=Job)
    if os.getppid() != job.parent:
        sys.exit(1)  # the parent was gone before its death could be signalled
    run(job)


if __name__ == "__main__":
    main()
