"""Stress: programs of ordinary priority load cores, memory and disk while something is measured.

The thesis loads its machine with the program `stress`. Where `stress-ng` is installed the load is as there:
every core busy, and two processes that allocate and free up to 2 GB each; one writes to the disk beside them.
Without it two processes of Python take its place: one computes, one allocates and writes.

    with Stress() as stress:
        ...
        stress.ended()      # whether the load ended by itself, for the report
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from typing import Self

from dxlrun import ProcessFault
from dxlrun.tooling.output import counted

MOST_MEMORY = 2 << 30
"""Bytes that one process allocates, as in the thesis; two take at most half of what is free."""
_START_S = 0.5
"""After which the load is at work."""
_DISK = "/var/tmp"  # noqa: S108  files without a name; unlike /tmp it is on a disk (FHS 3.0, 5.15)

_WITH_PARENT = """
import ctypes, os, signal, sys
ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG: it ends with the measurement
if os.getppid() != int(sys.argv[1]):
    sys.exit()
"""
_EXECUTE = "os.execvp(sys.argv[2], sys.argv[2:])"
_COMPUTE = "while True: pass"
_ALLOCATE_AND_WRITE = """
import mmap, tempfile
open("/proc/self/oom_score_adj", "w").write("1000")  # the first to go where memory becomes short
with tempfile.TemporaryFile(dir=sys.argv[3], buffering=0) as file:
    while True:
        with mmap.mmap(-1, int(sys.argv[2])) as memory:
            for page in range(0, len(memory), mmap.PAGESIZE):
                memory[page] = 1
        file.seek(0)
        file.write(os.urandom(1 << 24))
        os.fsync(file.fileno())
"""


class Stress:
    """A load that lasts as long as the block it is entered for; `wanted=False`: none."""

    def __init__(self, *, wanted: bool = True) -> None:
        self.text = ""
        """The load in words; empty: none."""
        self._programs: list[tuple[str, ...]] = []
        self._running: list[subprocess.Popen[bytes]] = []
        cores, free = len(os.sched_getaffinity(0)), os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        memory = min(MOST_MEMORY, free // 4)
        amount = f"{memory / 2**30:.2g} GB"
        if wanted and shutil.which("stress-ng"):
            self.text = (
                f"stress-ng, {counted(cores, 'busy process', 'busy processes')}, 2 that allocate {amount} "
                f"each, 1 that writes to {_DISK}"
            )
            words = ("stress-ng", "--quiet", "--cpu", str(cores), "--vm", "2", "--vm-bytes", str(memory))
            self._programs = [(_EXECUTE, *words, "--hdd", "1", "--temp-path", _DISK)]
        elif wanted:
            self.text = f"1 busy process, 1 that allocates {amount} and writes to {_DISK}"
            self._programs = [(_COMPUTE,), (_ALLOCATE_AND_WRITE, str(memory), _DISK)]

    def __enter__(self) -> Self:
        """Start the load. Raises ProcessFault where it does not stay."""
        for code, *words in self._programs:
            command = [sys.executable, "-c", _WITH_PARENT + code, str(os.getpid()), *words]
            self._running.append(
                subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    start_new_session=True,  # a Ctrl-C ends the measurement, and that the load
                )
            )
        until = time.monotonic() + _START_S
        while self._running and not self.ended() and time.monotonic() < until:
            time.sleep(0.02)
        if self.ended():
            self.__exit__()
            raise ProcessFault(f"the load did not start ({self.text})")
        return self

    def __exit__(self, *_: object) -> None:
        """End all of it."""
        for process in self._running:
            process.terminate()
        for process in self._running:
            process.wait()
        self._running.clear()

    def ended(self) -> tuple[str, ...]:
        """Return a sentence where the load, or a part of it, ended by itself."""
        gone = any(process.poll() is not None for process in self._running)
        return ("the load ended before the measurement did",) if gone else ()
