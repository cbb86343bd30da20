"""Measuring process of `dxlrun latency`: waits for deadlines with the clock and the pacing of the loop.

The process is set up like the loop's (one thread, real-time settings, measured margin) and waits on the same
clock. Between two waits it only stores the times. For the yardstick, it is set up in the same way and then
executes the C program, which inherits policy, priority, cores and timer slack (execve(2), prctl(2)). Only the
lock of memory is lost, so the C program requests it again.
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
from dxlrun_lab.latency.buffer import Buffer, BufferOffset

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class WakeUpJob(msgspec.Struct, frozen=True):
    """Job of a measuring process, passed as JSON on its command line"""

    parent: int
    """Process ID of the parent; this process ends with it."""
    scheduler: SchedulerPlan
    period_ns: int
    iterations: int
    """Number of wake-ups; with 0, only report the granted settings"""
    buffer: int
    """Descriptor of the shared memory"""
    grants: int
    """Descriptor of an anonymous file for the granted settings"""
    yardstick: str = ""
    """Path of the C program; empty to wait as the loop does"""


def measure_wake_ups(deadlines: Deadlines, iterations: int, buffer: Buffer) -> None:
    """Wait for `iterations` deadlines, and store deadline and wake-up time of each in the shared memory.

    Ends early if the front process requests it.
    """
    words = buffer.words
    done, stop = (
        int(BufferOffset.DONE),
        int(BufferOffset.STOP),
    )  # plain integers: members of an enum are slower
    place = int(BufferOffset.WAKE_UPS)
    for number in range(1, iterations + 1):
        words[place], words[place + 1] = deadlines.wait_for_deadline()
        place += 2
        store(words, done, number)  # release store: readers see both times first
        if words[stop]:
            return


def run(job: WakeUpJob) -> None:
    """Apply real-time settings, report the granted ones, then measure.

    With `yardstick` this process becomes the C program, which measures in its place. With 0 iterations
    nothing is measured. Wake-ups and used processor time are stored in the shared memory.
    """
    buffer = Buffer(job.buffer)
    grants = realtime.apply_scheduler(job.scheduler)
    deadlines = Deadlines(job.period_ns)
    if job.iterations and not job.yardstick:
        grants = (*grants, deadlines.measure_margin(job.scheduler.polling_ns))
        buffer.words[BufferOffset.MARGIN_NS] = deadlines.margin_ns
    os.pwrite(job.grants, msgspec.json.encode(grants), 0)
    if job.yardstick:
        words = (job.buffer, job.iterations, job.period_ns, int(job.scheduler.lock_memory))
        os.execv(job.yardstick, ("yardstick", *map(str, words)))  # noqa: S606  compiled a moment ago
    if not job.iterations:
        return
    buffer.touch_pages()
    begin_cpu_ns, begin_ns = time.process_time_ns(), time.monotonic_ns()
    measure_wake_ups(deadlines, job.iterations, buffer)
    buffer.words[BufferOffset.CPU_NS] = time.process_time_ns() - begin_cpu_ns
    buffer.words[BufferOffset.WALL_NS] = time.monotonic_ns() - begin_ns


def main() -> None:
    """Run the job on the command line: `JOB-AS-JSON`."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    job = msgspec.json.decode(sys.argv[1], type=WakeUpJob)
    if os.getppid() != job.parent:
        sys.exit(1)  # the parent exited before prctl, so there will be no signal
    run(job)


if __name__ == "__main__":
    main()
