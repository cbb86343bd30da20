"""Ports: the handles of serial lines; bytes out, bytes in before a deadline."""

from __future__ import annotations

import errno
import io
import os
import select
import time
from collections.abc import Callable, Sequence
from typing import Protocol

import msgspec

from dxlwire.errors import PortError

# found at once, some dozen times a cycle
_write, _now_ns = os.write, time.monotonic_ns

_WRITE_TIMEOUT_NS = 20_000_000
"""A goal packet for 50 servos takes 2.6 ms at 1 Mbit/s; a line that does not take it in 20 ms is stuck."""

LONGEST_STALL_NS = 500_000_000
"""A simulated servo that has not answered by then is lost, whatever its process does: the shutdown of a run
has two seconds, and a person notices a robot that stands still for half a second."""
_STALL_STEP_NS = 1_000_000  # Between two looks at the progress of a process that has no core
_SAME_STALL_NS = 10_000_000  # Waits that are no further apart count as one

Reopened = Callable[[int], int | None]
"""Asks the process that opens lines for one again; returns its descriptor once there is one; never waits."""


AUTO_SHARE = 0.1
"""Share of a core that polling for replies takes at most, if the file does not set how long to poll."""
MOST_SHARE = 0.5  # The same where the file does


class ReplyPolling(msgspec.Struct):
    """How replies are polled for: asleep until shortly before they are due by the plan, then looked for.

    Waking a process that blocks costs some 50 us on a stock Linux, of each reply. What is polled is credit:
    a share of the time that passes, so that no more than that share of a core is ever spent on it. Only the
    exchange kernel polls.
    """

    longest_ns: int = 1_000_000
    """A reply is polled for at most so long: beyond that it is late, or lost."""
    share: float = AUTO_SHARE
    margin_ns: int = 60_000
    """How long before a reply is expected sleeping ends; as sleeps were measured to overshoot."""


class Port(Protocol):
    """One serial line; nothing here waits. Raises PortError when the adapter is gone."""

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Hand one whole packet to the line."""
        ...

    def read_into(self, buffer: memoryview) -> int:
        """Copy what has arrived into `buffer`; return the number of bytes, 0 when there is nothing."""
        ...

    def failure(self, code: int) -> PortError:
        """Return the error of a write that ended with an errno, or with -1: it takes no more bytes."""
        ...

    def extend_deadline(self, deadline_ns: int, off_wire_ns: int, heard_ns: int, now_ns: int) -> int:
        """Return until when a reply is awaited of which not all has come by its deadline.

        Later than `now_ns` only where the device behind the line itself had no processor to answer with, as
        the process of simulated servos may have none; of real servos it is always `deadline_ns`.

        Args:
            deadline_ns: Deadline by the plan.
            off_wire_ns: When the last byte of the request is off the wire.
            heard_ns: When the newest byte was received on the line.
            now_ns: Time now.
        """
        ...

    def stalled_ns(self, since_ns: int, until_ns: int) -> int:
        """Return for how long the device behind the line had no processor between two times; 0: a servo."""
        ...

    def late_ns(self, off_wire_ns: int, heard_ns: int) -> int:
        """Return by how much the newest reply is late because the device behind the line had no processor.

        `off_wire_ns`: when its request was off the wire; `heard_ns`: when it was received.
        """
        ...


class Ports(Protocol):
    """All lines of a robot, waited for together."""

    @property
    def polling(self) -> ReplyPolling | None:
        """How replies are polled for; None: not at all."""
        ...

    @property
    def descriptors(self) -> Sequence[int] | None:
        """The lines' file descriptors; None where there are none, on virtual time."""
        ...

    @property
    def ports(self) -> Sequence[Port]:
        """The lines, in the order of the plan's buses."""
        ...

    def wait(self, deadline_ns: int) -> Sequence[int]:
        """Wait for bytes on any line until `deadline_ns`; return the indices of lines with bytes.

        Empty when time is up. Advances virtual time where time is virtual. `deadline_ns` is on the run's
        Clock; a deadline in the past only looks.
        """
        ...

    def reopen(self, index: int) -> bool:
        """Ask for a line that is lost again; return whether it is back, in its place in `ports`. Never waits.

        From the first call on the line that is gone is not waited for any more. What stands behind a line
        that is back was without a host, and maybe without power: all its servos count as rebooted.
        """
        ...


class OwnProcessors:
    """Part of the port of a line whose devices have processors of their own: the host does not delay them."""

    def extend_deadline(self, deadline_ns: int, off_wire_ns: int, heard_ns: int, now_ns: int) -> int:
        """Return `deadline_ns`."""
        return deadline_ns

    def stalled_ns(self, since_ns: int, until_ns: int) -> int:
        """Return 0."""
        return 0

    def late_ns(self, off_wire_ns: int, heard_ns: int) -> int:
        """Return 0."""
        return 0


class SerialPort(OwnProcessors):
    """A serial line by its descriptor, made non-blocking; opened, locked and set up by another process."""

    def __init__(self, descriptor: int, name: str) -> None:
        os.set_blocking(descriptor, False)
        self.descriptor = descriptor
        # makes no exception of an empty line, and knows no more than the number either
        self._read_into = io.FileIO(descriptor, closefd=False).readinto
        self.name = name  # Device path, for messages
        self.announced = False
        """True when a wait reported bytes: to find none then means that the line is lost."""

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Hand one whole packet to the line; raises PortError when the adapter is gone."""
        try:
            count = _write(self.descriptor, data)
        except BlockingIOError:
            count = 0
        except OSError as error:
            raise self._gone(error) from error
        if count != len(data):
            self._write_rest(memoryview(data)[count:])

    def _write_rest(self, data: memoryview) -> None:
        """Wait for room in the output queue; packets are short, so a full queue is stuck."""
        deadline = time.monotonic_ns() + _WRITE_TIMEOUT_NS
        while data:
            left = deadline - time.monotonic_ns()
            if left <= 0:
                raise self.failure(-1)
            try:
                select.select([], [self.descriptor], [], left * 1e-9)
                data = data[os.write(self.descriptor, data) :]
            except BlockingIOError:
                continue
            except OSError as error:
                raise self._gone(error) from error

    def read_into(self, buffer: memoryview) -> int:
        """Copy what has arrived into `buffer`; raises PortError when the adapter is gone."""
        try:
            count = self._read_into(buffer)
        except OSError as error:
            raise self._gone(error) from error
        if count == 0 and self.announced:  # ready to be read, and at its end: the other side hung up
            raise self._gone(None)
        self.announced = False
        return count or 0  # None where a read would have waited

    def renewed(self) -> SerialPort:
        """Return the port of the same line after it was opened again under the same descriptor."""
        return SerialPort(self.descriptor, self.name)

    def failure(self, code: int) -> PortError:
        """Return the error of a write that ended with an errno, or with -1: it takes no more bytes."""
        if code < 0:
            return PortError(f"{self.name} takes no more bytes: is the adapter stuck, or the line held?")
        return self._gone(OSError(code, os.strerror(code)))

    def _gone(self, error: OSError | None) -> PortError:
        why = f" ({error.strerror})" if error is not None and error.errno != errno.EBADF else ""  # set aside
        return PortError(f"{self.name} is gone{why}: was the adapter unplugged?")


class StallCounter:
    """Time for which replies of simulated servos were awaited beyond their deadlines, of all lines."""

    __slots__ = ("_until_ns", "times", "waited_ns")

    def __init__(self) -> None:
        self.waited_ns = 0
        self.times = 0
        self._until_ns = 0

    def count(self, begin_ns: int, end_ns: int) -> None:
        """Count a wait, as far as it was not counted for another line; it may continue the one before."""
        if begin_ns - self._until_ns > _SAME_STALL_NS:
            self.times += 1
            self._until_ns = begin_ns
        self.waited_ns += max(0, end_ns - self._until_ns)
        self._until_ns = max(self._until_ns, end_ns)


class SimulatingProcess(Protocol):
    """A process that simulates servos, as their ports see it."""

    def stalled_ns(self, since_ns: int, until_ns: int) -> int:
        """Return for how long the process did not run between two times of CLOCK_MONOTONIC, ns."""
        ...


class LineProgress(Protocol):
    """Progress of a simulating process on one line; times are CLOCK_MONOTONIC, ns."""

    @property
    def process(self) -> SimulatingProcess:
        """The process."""
        ...

    @property
    def taken_ns(self) -> int:
        """Time at which the newest byte that the process received is off the wire; to be read first."""
        ...

    @property
    def served_ns(self) -> int:
        """Time before which every byte that was due to the host was sent to it."""
        ...

    @property
    def given_ns(self) -> int:
        """Time at which the newest bytes were sent to the host; 0 before the first."""
        ...

    @property
    def due_ns(self) -> int:
        """Time at which these bytes were due."""
        ...


class SimulatedPort(SerialPort):
    """Pseudo-terminal of simulated servos, whose process may have to wait for a core.

    A reply is awaited beyond its deadline as long as `progress` shows that this process has not taken the
    request, has not served the line up to the deadline, or has handed over bytes that the kernel still has;
    at most LONGEST_STALL_NS after the request. The deadline counts from when the request was taken.
    """

    def __init__(self, descriptor: int, name: str, progress: LineProgress, stalls: StallCounter) -> None:
        super().__init__(descriptor, name)
        self._progress = progress
        self._stalls = stalls
        self._given_up: tuple[int, int] | None = None  # Progress of a process that was waited for in vain

    def renewed(self) -> SimulatedPort:
        """Return the port of the same line after it was opened again under the same descriptor."""
        return SimulatedPort(self.descriptor, self.name, self._progress, self._stalls)

    def extend_deadline(self, deadline_ns: int, off_wire_ns: int, heard_ns: int, now_ns: int) -> int:
        """Return how long a reply is awaited whose deadline has passed."""
        progress = self._progress
        taken_ns, served_ns, given_ns = progress.taken_ns, progress.served_ns, progress.given_ns
        if (taken_ns, served_ns) == self._given_up:
            return deadline_ns
        until_ns = now_ns + _STALL_STEP_NS
        if taken_ns >= off_wire_ns:
            deadline_ns += taken_ns - off_wire_ns
            on_the_way = given_ns > max(heard_ns, off_wire_ns)
            if served_ns >= deadline_ns and not on_the_way:
                return now_ns  # whatever comes is later than that on purpose
            until_ns = max(until_ns, min(deadline_ns, served_ns))
        latest_ns = off_wire_ns + LONGEST_STALL_NS
        if now_ns >= latest_ns:
            self._given_up = taken_ns, served_ns
            return now_ns
        self._stalls.count(now_ns, now_ns + _STALL_STEP_NS)
        return min(until_ns, latest_ns)

    def stalled_ns(self, since_ns: int, until_ns: int) -> int:
        """Return for how long the process of the simulated servos did not run between two times."""
        return self._progress.process.stalled_ns(since_ns, until_ns)

    def late_ns(self, off_wire_ns: int, heard_ns: int) -> int:
        """Return by how much the newest reply is late by its process, which took or gave bytes late."""
        taken_late_ns = max(0, self._progress.taken_ns - off_wire_ns)
        return taken_late_ns + max(0, heard_ns - self._progress.due_ns)


class SerialPorts:
    """The serial lines of a robot on the machine's monotonic time.

    `reopened` asks for a line that is gone; without it such a line stays gone.
    """

    def __init__(
        self,
        ports: Sequence[SerialPort],
        reopened: Reopened = lambda _: None,
        polling: ReplyPolling | None = None,
    ) -> None:
        self.polling = polling
        self._poll = select.poll()
        for port in ports:
            self._poll.register(port.descriptor, select.POLLIN)
        self._ports = list(ports)
        self._waited = [port.descriptor for port in ports]
        self._index = {port.descriptor: index for index, port in enumerate(ports)}
        self._reopened = reopened

    @property
    def ports(self) -> Sequence[SerialPort]:
        """The lines, in the order of the plan's buses."""
        return self._ports

    @property
    def descriptors(self) -> Sequence[int]:
        """The lines' descriptors; one that is opened again keeps its number."""
        return [port.descriptor for port in self._ports]

    def wait(self, deadline_ns: int) -> Sequence[int]:
        """Wait for bytes on any line until `deadline_ns` of CLOCK_MONOTONIC; a past deadline only looks."""
        left_ns = deadline_ns - _now_ns()
        found: list[tuple[int, int]] = []
        # poll has milliseconds, select has microseconds: what is left of a millisecond
        if left_ns >= 1_000_000:
            found = self._poll.poll(left_ns // 1_000_000)
            left_ns = 0 if found else deadline_ns - _now_ns()
        if not found:
            if left_ns > 0:
                select.select(self._waited, (), (), left_ns * 1e-9)
            found = self._poll.poll(0)
            if not found:
                return ()
        indices: list[int] = []
        for descriptor, _ in found:
            index = self._index[descriptor]
            self._ports[index].announced = True
            indices.append(index)
        return indices

    def reopen(self, index: int) -> bool:
        """Ask for a line that is gone again; its descriptor keeps its number, and is of nothing meanwhile."""
        gone = self._ports[index]
        if gone.descriptor in self._waited:
            self._waited.remove(gone.descriptor)
            self._poll.unregister(gone.descriptor)
            set_aside(gone.descriptor)
        descriptor = self._reopened(index)
        if descriptor is None:
            return False
        put_in_place(descriptor, gone.descriptor)
        self._ports[index] = gone.renewed()
        self._waited.append(gone.descriptor)
        self._poll.register(gone.descriptor, select.POLLIN)
        return True


def set_aside(descriptor: int) -> None:
    """Let go of a line that is gone: its device gets its old name again only when no process has it open."""
    put_in_place(os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC), descriptor)  # a write then fails


def put_in_place(new: int, descriptor: int) -> None:
    """Let `descriptor` be what `new` is, which is closed: code that has the number need not know."""
    os.dup2(new, descriptor, inheritable=False)
    os.close(new)
