"""Reopening: opens the lines of a robot, and opens a lost line again in a thread; used by the process that
holds the lines."""

from __future__ import annotations

import os
import queue
import select
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec

from dxlwire.exceptions import PortError
from dxlwire.port.latency_timer import SYSTEM, shorten
from dxlwire.port.ports import put_in_place, set_aside
from dxlwire.port.serial_open import DescribeProcess, describe_no_process, let_go, open_serial, rate_remark

FIRST_PAUSE_S = 0.1
LONGEST_PAUSE_S = 2.0  # Longest pause between two attempts on a line; each pause is twice the one before

_STACK = 1 << 18  # Stack size of a thread, bytes: memory may be locked and limited per user

_LASTING = Path("/dev/serial")


def lasting_name(path: str, lasting: Path = _LASTING) -> str:
    """Return a path that leads only to the adapter at `path`, also after it was replugged; empty for a
    pseudo-terminal.

    A link always leads to its adapter. A device such as /dev/ttyUSB0 may belong to another adapter next
    time, so udev's link by serial number or by position is used if it exists. A pseudo-terminal is gone
    for good, and the next program may get its name."""
    if os.path.islink(path):
        return path
    if path.startswith("/dev/pts/"):
        return ""
    device = os.path.realpath(path)
    links = (link for folder in ("by-id", "by-path") for link in sorted((lasting / folder).glob("*")))
    return next((str(link) for link in links if os.path.realpath(link) == device), path)


class LineSettings(msgspec.Struct, frozen=True):
    """Device and settings with which a line is opened, from the robot file."""

    path: str
    baud_rate: int
    latency_ns: int  # Longest acceptable latency timer of its adapter
    rs485: bool = False
    boot_ns: int = 0  # Boot time of the adapter after it was plugged in and opened
    socket: int = -1
    """Descriptor of a socket to simulated servos, in place of a device; -1: none. The opened lines own it and
    do not reopen it."""


class OpenedLine(msgspec.Struct, frozen=True):
    """Result of opening one line."""

    index: int
    descriptor: int
    done: str  # Sentence about a change of its latency timer; empty: unchanged
    wrong: str  # Sentence about a remaining problem; empty: none
    # Sentence about a baud rate that the driver did not set as requested; empty: as requested
    remark: str = ""


class KeptLines:
    """The open lines of a robot. A lost line is reopened when its adapter is back, however long that takes.

    A descriptor keeps its number while its line is lost and reopened. Each lost line is opened in a thread
    of its own: a driver may need seconds for it, and the process also has to supervise the loop."""

    def __init__(
        self,
        lines: Sequence[LineSettings],
        system: Path = SYSTEM,
        describe_holder: DescribeProcess = describe_no_process,
    ) -> None:
        """Open all lines.

        Args:
            lines: The lines.
            system: Root of sysfs, for tests.
            describe_holder: As in `open_serial`.

        Raises:
            PortError: A line cannot be opened, or the latency timer of its adapter is too long.
        """
        self.descriptors: list[int] = []  # In the order of the lines
        self.done: list[str] = []  # One sentence for each changed latency timer
        self.remarks: list[str] = []  # One sentence for each baud rate that a driver did not set as requested
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
        self._names = ["" if line.socket >= 0 else lasting_name(line.path) for line in lines]
        self._back: queue.SimpleQueue[OpenedLine] = queue.SimpleQueue()
        self._bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def fileno(self) -> int:
        """Return a descriptor for select that becomes readable when a lost line has been reopened."""
        return self._bell

    def lost(self, index: int) -> bool:
        """Release a lost line and start a thread that reopens it; return False if that is not possible."""
        set_aside(self.descriptors[index])
        if not self._names[index]:
            return False
        try:
            # Started only when needed: a thread inherits the priority of the thread that starts it
            threading.Thread(target=self._keep_trying, args=(index,), daemon=True).start()
        except RuntimeError:  # The system has no thread left
            return False
        return True

    def returned(self) -> list[OpenedLine]:
        """Return the lines that were reopened since the last call. They have their old descriptors."""
        found: list[OpenedLine] = []
        if select.select([self._bell], [], [], 0)[0]:
            os.eventfd_read(self._bell)
        while not self._back.empty():
            opened = self._back.get()
            put_in_place(opened.descriptor, self.descriptors[opened.index])
            found.append(opened)
        return found

    def close(self) -> None:
        """Unlock and close all lines."""
        let_go(self.descriptors)
        self.descriptors.clear()

    def _open(self, index: int, path: str) -> OpenedLine:
        line = self._lines[index]
        if line.socket >= 0:
            return OpenedLine(index, line.socket, "", "")
        port = open_serial(
            path,
            line.baud_rate,
            rs485=line.rs485,
            boot_ns=line.boot_ns,
            describe_holder=self._describe_holder,
        )
        done, wrong = shorten(port.fileno(), path, line.latency_ns, self._system)
        remark = rate_remark(port, line.baud_rate)
        return OpenedLine(index, port.detach(), done, wrong, remark)

    def _keep_trying(self, index: int) -> None:
        pause_s = FIRST_PAUSE_S
        while True:
            try:
                self._back.put(self._open(index, self._names[index]))
            except OSError:  # A PortError, or the adapter was unplugged again during the opening
                time.sleep(pause_s)
                pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
            else:
                os.eventfd_write(self._bell, 1)
                return
