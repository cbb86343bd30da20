"""Ports: write to and read from open serial lines without blocking, and wait for bytes on all lines at
once."""

from __future__ import annotations

import errno
import io
import os
import select
import time
from collections.abc import Callable, Sequence
from typing import Protocol

import msgspec

from dxlwire.exceptions import PortError

# Local names save attribute lookups: these are called some dozen times a cycle.
_write, _now_ns = os.write, time.monotonic_ns

_WRITE_TIMEOUT_NS = 20_000_000
"""Time after which a line that accepts no bytes counts as stuck, ns: a goal packet for 50 servos takes 2.6
ms at 1 Mbit/s."""

LONGEST_STALL_NS = 500_000_000
"""Longest wait for a stalled simulated servo, ns, after which it counts as lost. The shutdown of a run has
two seconds, and a person notices a robot that stops for half a second."""
_STALL_STEP_NS = 1_000_000  # Interval at which the progress of a stalled process is checked
_SAME_STALL_NS = 10_000_000  # Waits with a shorter gap than this count as one

Reopened = Callable[[int], int | None]
"""Requests a new descriptor of a lost line, by its index, from the process that opens lines; returns the
descriptor, or None until it is available. Never waits."""


AUTO_SHARE = 0.1
"""Highest share of a processor core for reply polling, unless the robot file sets the polling time."""
MOST_SHARE = 0.5  # The same if the file sets it


class ReplyPolling(msgspec.Struct):
    """Settings of reply polling: the kernel sleeps until shortly before a reply is due, then polls for it.

    On a stock Linux the wake-up of a blocked process costs some 50 us per reply. Polling draws on a
    credit: a share of the elapsed time, so that it never uses more than that share of a core. Only the
    exchange kernel polls."""

    longest_ns: int = 1_000_000
    """Longest polling for one reply, ns; a reply that comes later is late or lost."""
    share: float = AUTO_SHARE
    margin_ns: int = 60_000
    """Time before the expected reply at which the sleep ends, ns, because sleeps were measured to
    overshoot."""


class Port(Protocol):
    """One serial line, real or simulated, as bytes; no method waits.

    Raises PortError when the adapter is gone."""

    def write_packet(self, data: bytes | bytearray | memoryview) -> None:
        """Write one whole packet to the line."""
        ...

    def read_into(self, buffer: memoryview) -> int:
        """Copy received bytes into `buffer`; return their number, 0 if there are none."""
        ...

    def failure(self, code: int) -> PortError:
        """Return the exception for a failed write.

        Args:
            code: errno of the write, or -1 if the line accepts no more bytes.
        """
        ...

    def extend_deadline(self, deadline_ns: int, off_wire_ns: int, heard_ns: int, now_ns: int) -> int:
        """Return a later deadline for a reply that is incomplete at its deadline.

        It is later than `now_ns` only if the device at the other end had no processor, as the process of
        simulated servos may have none. For real servos it is always `deadline_ns`.

        Args:
            deadline_ns: Deadline by the plan.
            off_wire_ns: Time at which the last byte of the request is off the wire.
            heard_ns: Time at which the newest byte was received on the line.
            now_ns: Time now.
        """
        ...

    def stalled_ns(self, since_ns: int, until_ns: int) -> int:
        """Return how long the simulated servos had no processor between two times, ns; 0 for real servos."""
        ...

    def late_ns(self, off_wire_ns: int, heard_ns: int) -> int:
        """Return for how long (ns) the newest reply was late because the simulated servos had no
        processor; 0 for real servos.

        Args:
            off_wire_ns: Time at which its request was off the wire.
            heard_ns: Time at which the reply was received.
        """
        ...


class Ports(Protocol):
    """All open lines of a robot, with one wait for bytes on any line."""

    @property
    def polling(self) -> ReplyPolling | None:
        """Settings of reply polling in the exchange kernel; None: no polling."""
        ...

    @property
    def descriptors(self) -> Sequence[int] | None:
        """File descriptors of the lines; None for a simulation on virtual time."""
        ...

    @property
    def functions(self) -> int | None:
        """Address of the functions of compiled ports, `PortFunctions` of kernel.c; None: they have none.

        The exchange kernel then calls these functions instead of the methods of the ports. They must do the
        same, and return -1 where a method raises an exception: the method then raises it when it is called.
        """
        ...

    @property
    def ports(self) -> Sequence[Port]:
        """The open ports, in the order of the plan's buses."""
        ...

    def wait_for_bytes(self, deadline_ns: int) -> Sequence[int]:
        """Wait for bytes on any line until `deadline_ns`; return the indices of the readable lines.

        The result is empty after the deadline. On virtual time the wait advances the clock. A deadline in
        the past only checks the lines.

        Args:
            deadline_ns: Time on the run's Clock.
        """
        ...

    def reopen(self, index: int) -> bool:
        """Request that a lost line is opened again; return True if it is open, with a new port in `ports`.
        Never waits.

        From the first call on, the lost line is no longer part of `wait_for_bytes`. The devices on a reopened
        line were without a host, and possibly without power, so all its servos are treated as rebooted."""
        ...


class OwnProcessors:
    """Base class for ports of real servos, which have their own processors: the host cannot stall them."""

    def extend_deadline(self, deadline_ns: int, off_wire_ns: int, heard_ns: int, now_ns: int) -> int:
        """Return `deadline_ns`: a real servo is never waited for any longer."""
        return deadline_ns

    def stalled_ns(self, since_ns: int, until_ns: int) -> int:
        """Return 0: a real servo is never stalled."""
        return 0

    def late_ns(self, off_wire_ns: int, heard_ns: int) -> int:
        """Return 0: a real servo is never stalled."""
        return 0


class SerialPort(OwnProcessors):
    """Port on a non-blocking descriptor of a serial line, which another process opened, locked and
    configured."""

    def __init__(self, descriptor: int, name: str) -> None:
        os.set_blocking(descriptor, False)
        self.descriptor = descriptor
        # FileIO returns None for an empty line instead of raising an exception.
        self._read_into = io.FileIO(descriptor, closefd=False).readinto
        self.name = name  # Device path, for messages
        self.announced = False
        """True after a wait reported this line as readable. An empty read then means that the line is
        lost."""

    def write_packet(self, data: bytes | bytearray | memoryview) -> None:
        """Write one whole packet to the line. Raises PortError when the adapter is gone or accepts no
        bytes."""
        try:
            count = _write(self.descriptor, data)
        except BlockingIOError:
            count = 0
        except OSError as error:
            raise self._gone(error) from error
        if count != len(data):
            self._write_rest(memoryview(data)[count:])

    def _write_rest(self, data: memoryview) -> None:
        """Write the rest of a packet when the output queue has room; raise PortError after 20 ms, because
        only a stuck line stays full."""
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
        """Copy received bytes into `buffer`; return their number. Raises PortError when the adapter is
        gone."""
        try:
            count = self._read_into(buffer)
        except OSError as error:
            raise self._gone(error) from error
        if count == 0 and self.announced:  # Readable without data means end of file: the other side hung up
            raise self._gone(None)
        self.announced = False
        return count or 0  # None means that a read would have blocked

    def renewed(self) -> SerialPort:
        """Return a new port for the same line, which was reopened under the same descriptor."""
        return SerialPort(self.descriptor, self.name)

    def failure(self, code: int) -> PortError:
        """Return the exception for a failed write, given its errno, or -1 if the line accepts no more
        bytes."""
        if code < 0:
            return PortError(f"{self.name} accepts no more bytes; check for a stuck adapter or a held line")
        return self._gone(OSError(code, os.strerror(code)))

    def _gone(self, error: OSError | None) -> PortError:
        # EBADF: the descriptor was set aside
        why = f" ({error.strerror})" if error is not None and error.errno != errno.EBADF else ""
        return PortError(f"{self.name} is gone{why}; check that the adapter is plugged in")


class StallCounter:
    """Counts the time for which stalled simulated servos were awaited after the deadlines of their
    replies, over all lines."""

    __slots__ = ("_until_ns", "times", "waited_ns")

    def __init__(self) -> None:
        self.waited_ns = 0
        self.times = 0
        self._until_ns = 0

    def count(self, begin_ns: int, end_ns: int) -> None:
        """Count a wait from `begin_ns` to `end_ns`, without the time already counted for another line; it
        may extend the previous one."""
        if begin_ns - self._until_ns > _SAME_STALL_NS:
            self.times += 1
            self._until_ns = begin_ns
        self.waited_ns += max(0, end_ns - self._until_ns)
        self._until_ns = max(self._until_ns, end_ns)


class SimulatingProcess(Protocol):
    """Process that simulates servos, as seen by the ports of a run."""

    def suspended_ns(self, since_ns: int, until_ns: int) -> int:
        """Return how long the process did not run between two times of CLOCK_MONOTONIC, ns."""
        ...


class SimulatingLineProgress(Protocol):
    """Progress of the simulating process on one line, from memory that it shares; times are
    CLOCK_MONOTONIC, ns."""

    @property
    def process(self) -> SimulatingProcess:
        """Process that simulates the servos of the line."""
        ...

    @property
    def taken_ns(self) -> int:
        """Time at which the newest byte that the process has received is off the simulated wire. Read this
        property first."""
        ...

    @property
    def served_ns(self) -> int:
        """Time up to which the process has sent the host all bytes that were due."""
        ...

    @property
    def given_ns(self) -> int:
        """Time at which the process sent the newest bytes to the host; 0 before the first."""
        ...

    @property
    def due_ns(self) -> int:
        """Time at which the newest bytes that were sent to the host were due."""
        ...


class SimulatedPort(SerialPort):
    """Port of simulated servos: a socket to their process, which may have to wait for a processor core.

    A reply is awaited beyond its deadline while `progress` shows one of these: the process has not read
    the request, has not served the line up to the deadline, or has sent bytes that are still in the
    kernel's buffer. The limit is LONGEST_STALL_NS after the request. The deadline is counted from the time
    at which the process read the request."""

    def __init__(
        self, descriptor: int, name: str, progress: SimulatingLineProgress, stalls: StallCounter
    ) -> None:
        super().__init__(descriptor, name)
        self._progress = progress
        self._stalls = stalls
        # Progress at which waiting for the process was given up
        self._given_up: tuple[int, int] | None = None

    def renewed(self) -> SimulatedPort:
        """Return a new port for the same line, which was reopened under the same descriptor."""
        return SimulatedPort(self.descriptor, self.name, self._progress, self._stalls)

    def extend_deadline(self, deadline_ns: int, off_wire_ns: int, heard_ns: int, now_ns: int) -> int:
        """Return a later deadline for an overdue reply if the simulating process was stalled; see
        `Port.extend_deadline`."""
        progress = self._progress
        taken_ns, served_ns, given_ns = progress.taken_ns, progress.served_ns, progress.given_ns
        if (taken_ns, served_ns) == self._given_up:
            return deadline_ns
        until_ns = now_ns + _STALL_STEP_NS
        if taken_ns >= off_wire_ns:
            deadline_ns += taken_ns - off_wire_ns
            on_the_way = given_ns > max(heard_ns, off_wire_ns)
            if served_ns >= deadline_ns and not on_the_way:
                return now_ns  # The process was not delayed: any further reply is late on purpose
            until_ns = max(until_ns, min(deadline_ns, served_ns))
        latest_ns = off_wire_ns + LONGEST_STALL_NS
        if now_ns >= latest_ns:
            self._given_up = taken_ns, served_ns
            return now_ns
        self._stalls.count(now_ns, now_ns + _STALL_STEP_NS)
        return min(until_ns, latest_ns)

    def stalled_ns(self, since_ns: int, until_ns: int) -> int:
        """Return how long the process of the simulated servos did not run between two times, ns."""
        return self._progress.process.suspended_ns(since_ns, until_ns)

    def late_ns(self, off_wire_ns: int, heard_ns: int) -> int:
        """Return for how long (ns) the newest reply was late because the simulating process read or sent
        bytes late."""
        taken_late_ns = max(0, self._progress.taken_ns - off_wire_ns)
        return taken_late_ns + max(0, heard_ns - self._progress.due_ns)


class SerialPorts:
    """The open serial lines of a robot, for a run on the machine's monotonic time; implements `Ports`.

    Args:
        ports: The open lines.
        reopened: Requests a lost line; without it a lost line stays lost.
        polling: Settings of reply polling; None: no polling.
    """

    def __init__(
        self,
        ports: Sequence[SerialPort],
        reopened: Reopened = lambda _: None,
        polling: ReplyPolling | None = None,
    ) -> None:
        self.polling = polling
        self.functions = None
        """None, because the lines have file descriptors."""
        self._poll = select.poll()
        for port in ports:
            self._poll.register(port.descriptor, select.POLLIN)
        self._ports = list(ports)
        self._waited = [port.descriptor for port in ports]
        self._index = {port.descriptor: index for index, port in enumerate(ports)}
        self._reopened = reopened

    @property
    def ports(self) -> Sequence[SerialPort]:
        """The open ports, in the order of the plan's buses."""
        return self._ports

    @property
    def descriptors(self) -> Sequence[int]:
        """File descriptors of the lines; a reopened line keeps its number."""
        return [port.descriptor for port in self._ports]

    def wait_for_bytes(self, deadline_ns: int) -> Sequence[int]:
        """Wait for bytes on any line until `deadline_ns` of CLOCK_MONOTONIC; return the indices of the
        readable lines. A past deadline only checks them."""
        left_ns = deadline_ns - _now_ns()
        found: list[tuple[int, int]] = []
        # poll has a resolution of milliseconds, so select waits for the remaining microseconds.
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
        """Request that a lost line is opened again; return True if it is open.

        Until then its descriptor refers to the null device and keeps its number."""
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
    """Replace a lost line's descriptor by the null device. The device of a replugged adapter gets the same
    name again only if no process has the old one open."""
    # Opened read-only so that writes fail
    put_in_place(os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC), descriptor)


def put_in_place(new: int, descriptor: int) -> None:
    """Make `descriptor` refer to the file of `new`, and close `new`. Objects that use the number need no
    update."""
    os.dup2(new, descriptor, inheritable=False)
    os.close(new)
