"""Stress: programs of ordinary priority that load cores, memory and disk during a measurement.

The thesis uses the program `stress`. If `stress-ng` is installed, the load is the same: all cores are busy,
two processes allocate and free up to 2 GB each, and one process writes to the disk. Otherwise, two Python
processes replace it: one computes, and one allocates memory and writes.

    with Stress() as stress:
        ...
        stress.ended()      # remark for the report if the load ended early
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
"""Bytes that one process allocates, as in the thesis. Two processes take at most half of the free memory."""
_START_S = 0.5
"""Time after the start of the load before a measurement begins, s"""
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
    """Context manager that loads the machine by other processes; with `wanted=False` it does nothing."""

    def __init__(self, *, wanted: bool = True) -> None:
        self.text = ""
        """Description of the load; empty without one"""
        self._programs: list[tuple[str, ...]] = []
        self._running: list[subprocess.Popen[bytes]] = []
        cores, free = len(os.sched_getaffinity(0)), os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        memory = min(MOST_MEMORY, free // 4)
        amount = f"{memory / 2**30:.2g} GB"
        if wanted and shutil.which("stress-ng"):
            self.text = (
                f"stress-ng: {counted(cores, 'busy process', 'busy processes')}, 2 allocating {amount} "
                f"each, 1 writing to {_DISK}"
            )
            words = ("stress-ng", "--quiet", "--cpu", str(cores), "--vm", "2", "--vm-bytes", str(memory))
            self._programs = [(_EXECUTE, *words, "--hdd", "1", "--temp-path", _DISK)]
        elif wanted:
            self.text = f"1 busy process, 1 allocating {amount} and writing to {_DISK}"
            self._programs = [(_COMPUTE,), (_ALLOCATE_AND_WRITE, str(memory), _DISK)]

    def __enter__(self) -> Self:
        """Start the load, and wait until it is effective. Raises ProcessFault if it exits at once."""
        for code, *words in self._programs:
            command = [sys.executable, "-c", _WITH_PARENT + code, str(os.getpid()), *words]
            self._running.append(
                subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    start_new_session=True,  # Ctrl-C only reaches the measurement, which ends the load
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
        """Terminate the processes of the load."""
        for process in self._running:
            process.terminate()
        for process in self._running:
            process.wait()
        self._running.clear()

    def ended(self) -> tuple[str, ...]:
        """Return a remark if a process of the load has exited; empty while all run."""
        gone = any(process.poll() is not None for process in self._running)
        return ("the load ended before the measurement",) if gone else ()
