"""Reopening: a lost line is opened again by the process that keeps the lines."""

from __future__ import annotations

import os
import queue
import select
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec

from dxlwire.errors import PortError
from dxlwire.port.latency_timer import SYSTEM, shorten
from dxlwire.port.ports import put_in_place, set_aside
from dxlwire.port.serial_open import DescribeProcess, describe_no_process, let_go, open_serial, rate_remark

FIRST_PAUSE_S = 0.1
LONGEST_PAUSE_S = 2.0  # Between two attempts at a line; each pause is twice the one before

_STACK = 1 << 18  # Bytes for a thread: memory may be locked, and bounded by the user's limit

_LASTING = Path("/dev/serial")


def lasting_name(path: str, lasting: Path = _LASTING) -> str:
    """Return the name under which the adapter at `path` is there again; empty when it would be another one.

    A link leads to its adapter wherever that is. A device such as /dev/ttyUSB0 may be another adapter's next
    time: udev's link by the adapter's own number is taken instead where there is one. A pseudo-terminal is
    gone for good, and its name goes to the next program that asks for one.
    """
    if os.path.islink(path):
        return path
    if path.startswith("/dev/pts/"):
        return ""
    device = os.path.realpath(path)
    links = (link for folder in ("by-id", "by-path") for link in sorted((lasting / folder).glob("*")))
    return next((str(link) for link in links if os.path.realpath(link) == device), path)


class Wanted(msgspec.Struct, frozen=True):
    """A line as the robot file wants it."""

    path: str
    baud_rate: int
    latency_ns: int  # The longest that its adapter may keep replies back
    rs485: bool = False
    boot_ns: int = 0  # How long its adapter boots after it was plugged in and opened


class Opened(msgspec.Struct, frozen=True):
    """A line that was opened."""

    index: int
    descriptor: int
    done: str  # What was done to its latency timer; empty: nothing
    wrong: str  # What is wrong with it still; empty: nothing
    remark: str = ""  # About the rate that its driver set; empty: it is as asked


class KeptLines:
    """The lines of a robot, kept open; one that is gone is opened again, however long that takes.

    A descriptor keeps its number while the line behind it goes and comes. Opening happens in a thread, one a
    lost line: a driver may take seconds over it, and the process that keeps the lines has a loop to watch.
    """

    def __init__(
        self,
        lines: Sequence[Wanted],
        system: Path = SYSTEM,
        describe_holder: DescribeProcess = describe_no_process,
    ) -> None:
        """Open the lines; raises PortError when one cannot be opened, or keeps replies back for too long.

        Args:
            lines: The lines.
            system: Where the kernel shows its devices, for tests.
            describe_holder: As in `open_serial`.
        """
        self.descriptors: list[int] = []  # In the order of the lines
        self.done: list[str] = []  # What was done to latency timers, one sentence each
        self.remarks: list[str] = []  # About rates that drivers did not set as asked
        self._lines = tuple(lines)
        self._system = system
        self._describe_holder = describe_holder
        wrong: list[str] = []
        try:
            for index, line in enumerate(lines):
                opened = self._open(index, line.path)
                self.descriptors.append(opened.descriptor)
                self.done += [opened.done] if opened.done else []
                self.remarks += [opened.remark] if opened.remark else []
                wrong += [opened.wrong] if opened.wrong else []
            if wrong:
                raise PortError("\n".join(wrong))
        except PortError:
            self.close()
            raise
        threading.stack_size(_STACK)
        self._names = [lasting_name(line.path) for line in lines]
        self._back: queue.SimpleQueue[Opened] = queue.SimpleQueue()
        self._bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when a line is back, for select."""
        return self._bell

    def lost(self, index: int) -> bool:
        """Let go of a line that is gone, and open it again; return whether that is tried."""
        set_aside(self.descriptors[index])
        if not self._names[index]:
            return False
        try:
            # not before it is needed: a thread has the priority of the one that starts it
            threading.Thread(target=self._keep_trying, args=(index,), daemon=True).start()
        except RuntimeError:  # the system has no thread left
            return False
        return True

    def returned(self) -> list[Opened]:
        """Return which lines are back since the last look; their descriptors are the old ones."""
        found: list[Opened] = []
        if select.select([self._bell], [], [], 0)[0]:
            os.eventfd_read(self._bell)
        while not self._back.empty():
            opened = self._back.get()
            put_in_place(opened.descriptor, self.descriptors[opened.index])
            found.append(opened)
        return found

    def close(self) -> None:
        """Let go of all lines."""
        let_go(self.descriptors)
        self.descriptors.clear()

    def _open(self, index: int, path: str) -> Opened:
        line = self._lines[index]
        port = open_serial(
            path,
            line.baud_rate,
            rs485=line.rs485,
            boot_ns=line.boot_ns,
            describe_holder=self._describe_holder,
        )
        done, wrong = shorten(port.fileno(), path, line.latency_ns, self._system)
        remark = rate_remark(port, line.baud_rate)
        return Opened(index, port.detach(), done, wrong, remark)

    def _keep_trying(self, index: int) -> None:
        pause_s = FIRST_PAUSE_S
        while True:
            try:
                self._back.put(self._open(index, self._names[index]))
            except OSError:  # a PortError, or an adapter that went again in the middle of it
                time.sleep(pause_s)
                pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
            else:
                os.eventfd_write(self._bell, 1)
                return
