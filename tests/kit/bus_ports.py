"""Ports in Python, for a line of two buses, a bus that is held back, or a clock that stalls."""

from collections.abc import Sequence
from typing import Any

from dxlsim.virtual_ports import VirtualPort
from dxlwire.clock import VirtualClock
from dxlwire.exceptions import PortError


class BusPort(VirtualPort):
    """Host's end of one simulated bus, whose methods a test may replace: the exchange calls them."""

    def __init__(self, clock: VirtualClock, bus: Any) -> None:
        self._clock = clock
        self._bus = bus
        self._arrived = bytearray()
        self._unplugged = bus.times_unplugged

    def write_packet(self, data: bytes | bytearray | memoryview) -> None:
        """Write bytes to the line at the present virtual time. Raises PortError if the adapter was
        unplugged."""
        self._check()
        self._bus.receive_bytes(data, self._clock.now_ns())

    def read_into(self, buffer: memoryview) -> int:
        """Copy the bytes that have arrived; return their number. Raises PortError if the adapter was
        unplugged."""
        self._check()
        self.collect_bytes()
        size = min(len(buffer), len(self._arrived))
        buffer[:size] = self._arrived[:size]
        del self._arrived[:size]
        return size

    def failure(self, code: int) -> PortError:
        """Return the exception for a failed write; the only cause is an unplugged adapter."""
        return PortError(f"the adapter of bus {self._bus.name} is unplugged")

    def collect_bytes(self) -> bool:
        """Take the bytes that have passed the wire from the bus; return True if bytes are waiting or the
        adapter is gone."""
        if data := self._bus.drain_bytes(self._clock.now_ns()):
            self._arrived += data
        return bool(self._arrived) or self._gone

    @property
    def _gone(self) -> bool:
        """True after the adapter was unplugged, even if it is back: a port is not reusable after that."""
        return self._bus.times_unplugged != self._unplugged


class BusPorts:
    """All simulated lines of a robot on virtual time, with a common wait; implements `dxlwire`'s Ports."""

    def __init__(self, clock: VirtualClock, buses: Sequence[Any]) -> None:
        self.polling = self.descriptors = self.functions = None
        self._clock = clock
        self._buses = tuple(buses)
        self._ports = [BusPort(clock, bus) for bus in buses]
        self._lost: set[int] = set()

    @property
    def ports(self) -> Sequence[BusPort]:
        """The ports of the lines, in the order of the buses."""
        return self._ports

    def wait_for_bytes(self, deadline_ns: int) -> Sequence[int]:
        """Advance virtual time until bytes arrive or `deadline_ns`; return the indices of readable lines."""
        while True:
            # Time passes for the servos of a lost line, too.
            received = [index for index, port in enumerate(self._ports) if port.collect_bytes()]
            ready = [index for index in received if index not in self._lost]
            now_ns = self._clock.now_ns()
            if ready or now_ns >= deadline_ns:
                return ready
            due = [due_ns for bus in self._buses if (due_ns := bus.next_due_ns()) is not None]
            self._clock.wait_until(min([deadline_ns, *due]))

    def reopen(self, index: int) -> bool:
        """Request a lost line again; return True, with a new port in `ports`, once its adapter is plugged
        in."""
        self._lost.add(index)
        bus = self._buses[index]
        bus.advance_to(self._clock.now_ns())
        if not bus.plugged:
            return False
        self._lost.remove(index)
        self._ports[index] = BusPort(self._clock, bus)
        return True
