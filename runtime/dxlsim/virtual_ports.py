"""Virtual ports: connect the exchange to simulated buses on virtual time, without process, terminal or
real waiting.

`line.c` has the ports; the exchange kernel calls its functions directly."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.wire.compiled_line import ADVANCE, Port, Ports, line_library
from dxlwire.clock import VirtualClock
from dxlwire.exceptions import PortError


class VirtualPort:
    """Host's end of one simulated bus on virtual time; implements `dxlwire`'s Port."""

    def __init__(self, ports: VirtualPorts, index: int, bus: SimulatedBus) -> None:
        self._ports = ports
        self._index = index
        self._bus = bus
        self._unplugged = bus.times_unplugged
        self._library = line_library()
        self._library.line_open_port(ports.functions, index)

    def write_packet(self, data: bytes | bytearray | memoryview) -> None:
        """Write bytes to the line at the present virtual time. Raises PortError if the adapter was
        unplugged."""
        self._check()
        self._library.line_port_send(self._ports.functions, self._index, bytes(data), len(data))
        self._ports.raise_stored()

    def read_into(self, buffer: memoryview) -> int:
        """Copy the bytes that have arrived; return their number. Raises PortError if the adapter was
        unplugged."""
        self._check()
        room = (ctypes.c_char * len(buffer)).from_buffer(buffer)
        count: int = self._library.line_port_receive(self._ports.functions, self._index, room, len(buffer))
        self._ports.raise_stored()
        self._check()
        return count

    def failure(self, code: int) -> PortError:
        """Return the exception for a failed write; the only cause is an unplugged adapter."""
        self._ports.raise_stored()
        return PortError(f"the adapter of bus {self._bus.name} is unplugged")

    def extend_deadline(self, deadline_ns: int, off_wire_ns: int, heard_ns: int, now_ns: int) -> int:
        """Return `deadline_ns`: virtual time waits for the servos, so none is stalled."""
        return deadline_ns

    def stalled_ns(self, since_ns: int, until_ns: int) -> int:
        """Return 0: virtual time waits for the servos, so none is stalled."""
        return 0

    def late_ns(self, off_wire_ns: int, heard_ns: int) -> int:
        """Return 0: virtual time waits for the servos, so none is stalled."""
        return 0

    def unplug(self) -> None:
        """Unplug the adapter: every later use of this port raises PortError."""
        self._bus.unplug()

    def _check(self) -> None:
        """Raise PortError after the adapter was unplugged, even if it is back: a port is not reusable after
        that."""
        if self._bus.times_unplugged != self._unplugged:
            raise self.failure(-1)


class VirtualPorts:
    """All simulated lines of a robot on virtual time, with a common wait; implements `dxlwire`'s Ports."""

    def __init__(self, clock: VirtualClock, buses: Sequence[SimulatedBus]) -> None:
        self.polling = self.descriptors = None
        """None, because virtual time needs neither polling nor file descriptors."""
        self._clock = clock
        self._buses = tuple(buses)
        self._raised: BaseException | None = None
        self._advance = ADVANCE(self._advance_clock)
        self._lines = (Port * max(len(buses), 1))(*(Port(bus=bus.address) for bus in buses))
        self._state = Ports(
            ports=ctypes.addressof(self._lines),
            clock=clock.state.buffer_info()[0],
            advance=ctypes.cast(self._advance, ctypes.c_void_p),
            count=len(buses),
        )
        self.functions = ctypes.addressof(self._state)
        """Address of the compiled functions."""
        self._library = line_library()
        self._library.line_open_ports(self.functions)
        self._ports = [VirtualPort(self, index, bus) for index, bus in enumerate(buses)]

    @property
    def ports(self) -> Sequence[VirtualPort]:
        """The ports of the lines, in the order of the buses."""
        return self._ports

    def wait_for_bytes(self, deadline_ns: int) -> Sequence[int]:
        """Advance virtual time until bytes arrive or `deadline_ns`; return the indices of readable lines."""
        ready = ctypes.create_string_buffer(len(self._lines))
        found = self._library.line_port_wait(self.functions, deadline_ns, ready)
        self.raise_stored()
        return [index for index, flag in enumerate(ready.raw) if flag] if found else []

    def reopen(self, index: int) -> bool:
        """Request a lost line again; return True, with a new port in `ports`, once its adapter is plugged
        in."""
        self._lines[index].lost = 1
        bus = self._buses[index]
        bus.advance_to(self._clock.now_ns())
        if not bus.plugged:
            return False
        self._ports[index] = VirtualPort(self, index, bus)
        return True

    def raise_stored(self) -> None:
        """Raise the exception of a scheduled call or of a simulated servo that compiled code could not
        raise."""
        if self._state.raised:
            raised, self._raised, self._state.raised = self._raised, None, 0
            raise raised or KeyboardInterrupt  # As in `SimulatedBus.raise_stored`
        for bus in self._buses:
            bus.raise_stored()

    def _advance_clock(self, until_ns: int) -> int:
        try:
            return self._clock.wait_until(until_ns)
        except BaseException as error:
            self._raised, self._state.raised = error, 1
            return 0
        finally:
            self._state.done = 1
