"""Stress: load every core, memory and disk with processes of ordinary priority, as other programs would.

The thesis loads its machine with the program `stress`: every core busy, and two processes that allocate and
free 2 GB each, over and over. This is that load with a disk written beside it, made here because neither
`stress` nor `stress-ng` is a program that a robot's computer has to have.

    with Stress(full_load()) as stress:
        ...
        stress.ended()      # parts of the load that ended by themselves, for the report

One process is started, and it forks one for each part of the load. All of them end with the block, and also
when the process that entered it is killed: each asks the operating system for SIGKILL at its parent's death
(PR_SET_PDEATHSIG; strictly, at the end of the parent's thread, so enter the block in a thread that stays).
"""

from __future__ import annotations

import ctypes
import math
import mmap
import os
import select
import signal
import socket
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Literal, NoReturn

import msgspec

from dxlrun.channels.process import START_TIMEOUT_S, Child, MessageChannel, memory_file, whole
from dxlrun.errors import ProcessFault, counted

Kind = Literal["cores", "memory", "disk"]

MOST_MEMORY = 2 << 30
"""Bytes that one process allocates, as in the thesis; less where less is free."""
MEMORY_PROCESSES = 2
_LEAST_MEMORY = 16 << 20
_SHARE_OF_MEMORY = 2
"""All processes together take one part in so many of what is free, so that nothing is killed for it."""
_DISK_FILE = 64 << 20
"""Bytes that are written before the file is cut and written again."""
_DISK_BLOCK = 1 << 20
"""Bytes between two fsync."""
_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_MEMINFO = Path("/proc/meminfo")
_ON_DISK = Path("/var/tmp")  # noqa: S108  a file without a name; unlike /tmp it is on a disk (FHS 3.0, 5.15)


@dataclass(frozen=True, slots=True)
class Load:
    """What is to be loaded; a part that is 0 or empty is left out."""

    cores: int
    """Processes that compute."""
    memory_processes: int
    """Processes that allocate memory, touch each page, and free it."""
    memory_bytes: int
    """What each of them allocates."""
    directory: str
    """Where one process writes and syncs a file without a name."""

    @property
    def parts(self) -> tuple[Kind, ...]:
        """One for each process."""
        memory = self.memory_processes if self.memory_bytes else 0
        return (
            *("cores",) * self.cores,
            *("memory",) * memory,
            *(("disk",) if self.directory else ()),
        )

    @property
    def text(self) -> str:
        """The load in words."""
        memory = self.memory_processes if self.memory_bytes else 0
        parts = (
            counted(self.cores, "busy process", "busy processes") if self.cores else "",
            f"{memory} that allocate{'s' * (memory == 1)} {self.memory_bytes / 2**30:.2g} GB"
            f"{' each' * (memory > 1)}"
            if memory
            else "",
            f"1 that writes to {self.directory}" if self.directory else "",
        )
        return ", ".join(part for part in parts if part) or "nothing"


def full_load() -> Load:
    """Return the load of the thesis for this machine: every core that this process may use, memory as far as
    it is free, and a disk."""
    memory = min(MOST_MEMORY, _free_memory() // (_SHARE_OF_MEMORY * MEMORY_PROCESSES))
    directory = _ON_DISK if os.access(_ON_DISK, os.W_OK) else Path(tempfile.gettempdir())
    return Load(
        len(os.sched_getaffinity(0)),
        MEMORY_PROCESSES,
        memory if memory >= _LEAST_MEMORY else 0,
        str(directory),
    )


def _free_memory(meminfo: Path = _MEMINFO) -> int:
    """Return the bytes that programs may still take (MemAvailable, proc(5)); 0 where it is not known."""
    with suppress(OSError):
        for line in meminfo.read_text().splitlines():
            name, _, value = line.partition(":")
            if name == "MemAvailable":
                return int(value.split()[0]) << 10
    return 0


class Working(msgspec.Struct, frozen=True, tag=True):
    """A part of the load is at work."""


class Ended(msgspec.Struct, frozen=True, tag=True):
    """A part of the load ended by itself."""

    kind: Kind
    reason: str

    @property
    def text(self) -> str:
        """A clause."""
        names = {
            "cores": "a busy process",
            "memory": "a process that allocates memory",
            "disk": "the process that writes to the disk",
        }
        return f"{names[self.kind]} ended ({self.reason})"


_FromLoad = msgspec.json.Decoder(Working | Ended)


class Stress:
    """A load that lasts as long as the block it is entered for."""

    def __init__(self, load: Load) -> None:
        self.load = load
        self._child: Child[Working | Ended] | None = None
        self._ended: list[str] = []

    def __enter__(self) -> Stress:
        """Start the load; return when every part of it is at work. Raises ProcessFault where one is not."""
        words = [msgspec.json.encode(self.load).decode(), "--parent", str(os.getpid())]
        errors = memory_file("stress")
        try:
            self._child = Child("load", "dxlrun_lab.stress", words, [], errors, _FromLoad)
            self._await(self._child, errors)
        except BaseException:
            self._stop()
            raise
        finally:
            os.close(errors)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End all of it."""
        self.ended()
        self._stop()

    def ended(self) -> tuple[str, ...]:
        """Return a sentence for each part of the load that ended by itself until now."""
        while self._child and (message := self._child.poll(0)):
            if isinstance(message, Ended):
                self._ended.append(f"the load became smaller: {message.text}")
        if self._child and self._child.channel.closed:
            self._stop()
            self._ended.append("the load ended before the measurement did")
        return tuple(self._ended)

    def _await(self, child: Child[Working | Ended], errors: int) -> None:
        for _ in self.load.parts:
            message = child.message(START_TIMEOUT_S)
            if message is None:
                last = whole(errors).decode(errors="replace").strip().splitlines()[-1:]
                raise ProcessFault(f"the load did not start{''.join(f' ({line})' for line in last)}")
            if isinstance(message, Ended):
                raise ProcessFault(f"the load did not start: {message.text}")

    def _stop(self) -> None:
        child, self._child = self._child, None
        if child:
            child.end()


# In the processes of the load


def _compute(working: Callable[[], None]) -> NoReturn:
    """Keep a core busy."""
    working()
    value = 2.0
    while True:
        for _ in range(1000):
            value = math.sqrt(value + 1.0)


def _allocate(size: int, working: Callable[[], None]) -> NoReturn:
    """Allocate, touch each page and free, over and over."""
    size -= size % mmap.PAGESIZE
    ones = b"\1" * (size // mmap.PAGESIZE)
    while True:
        with mmap.mmap(-1, size) as memory:
            working()  # the work is the touching, which takes seconds
            with memoryview(memory) as view, view[:: mmap.PAGESIZE] as pages:
                pages[:] = ones


def _write(directory: str, working: Callable[[], None]) -> NoReturn:
    """Write a file without a name and have each block reach the disk; cut it and write it again."""
    block = os.urandom(_DISK_BLOCK)
    with tempfile.TemporaryFile(dir=directory, buffering=0) as file:
        while True:
            file.seek(0)
            file.truncate()
            for _ in range(_DISK_FILE // _DISK_BLOCK):
                file.write(block)
                os.fsync(file.fileno())
                working()


def _part(load: Load, kind: Kind, channel: MessageChannel[Working], parent: int) -> NoReturn:
    """Be one part of the load, in a process that was forked for it; never returns."""
    _end_with(parent)
    # the first to go where memory becomes short (proc(5)), before any program that is of use
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")
    announced = False

    def working() -> None:
        nonlocal announced
        if not announced:
            channel.send(Working())
            announced = True

    try:
        if kind == "cores":
            _compute(working)
        elif kind == "memory":
            _allocate(load.memory_bytes, working)
        else:
            _write(load.directory, working)
    except Exception as error:  # the last resort of this process: the report has it
        channel.send(Ended(kind, getattr(error, "strerror", None) or f"{type(error).__name__} {error}"))
    finally:
        os._exit(1)


def _end_with(parent: int) -> None:
    """Have this process killed when its parent is gone."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)  # the parent was gone before its death could be signalled


def _watch(channel: MessageChannel[Working], parts: dict[int, tuple[int, Kind]]) -> None:
    """Report parts that the operating system ended, until the other end closes the channel."""
    own = channel.fileno()
    while not channel.closed:
        ready, _, _ = select.select([own, *parts], [], [])
        if own in ready:
            channel.receive()
        for descriptor in parts.keys() & set(ready):
            process, kind = parts.pop(descriptor)
            _, status = os.waitpid(process, 0)
            if os.WIFSIGNALED(status):
                channel.send(Ended(kind, signal.Signals(os.WTERMSIG(status)).name))
            os.close(descriptor)


def main(words: Sequence[str]) -> None:
    """Be the load: `LOAD-AS-JSON --parent PID --control-fd FD`."""
    load = msgspec.json.decode(words[0], type=Load)
    _end_with(int(words[2]))
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    own = os.getpid()
    channel = MessageChannel(socket.socket(fileno=int(words[4])), msgspec.json.Decoder(Working))
    parts: dict[int, tuple[int, Kind]] = {}
    for kind in load.parts:
        process = os.fork()
        if not process:
            _part(load, kind, channel, own)
        parts[os.pidfd_open(process)] = process, kind
    _watch(channel, parts)
    for process, _ in parts.values():
        os.kill(process, signal.SIGKILL)
    for process, _ in parts.values():
        os.waitpid(process, 0)


if __name__ == "__main__":
    main(sys.argv[1:])
