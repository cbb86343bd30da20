from __future__ import annotations

import pytest

from dxlsim.bus.ledger import Ledger
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.simulation_plan import BusConfig, ServoConfig
from dxlsim.virtual_ports import VirtualPorts
from dxlwire.clock import VirtualClock
from dxlwire.exceptions import PortError
from dxlwire.port.ports import Ports

PING_1 = bytes.fromhex("ff ff 01 02 01 fb")
PONG_1 = bytes.fromhex("ff ff 01 02 00 fc")


def two_buses() -> tuple[VirtualClock, Ports, VirtualPorts]:
    clock = VirtualClock(1_000)
    buses = [
        SimulatedBus(BusConfig(name, 1_000_000, (ServoConfig(1, "AX-12A", 1.0, delay),)), Ledger(), 1_000)
        for name, delay in (("left", 500_000), ("right", 100_000))
    ]
    ports = VirtualPorts(clock, buses)
    return clock, ports, ports


def read(ports: Ports, index: int) -> bytes:
    buffer = bytearray(100)
    return bytes(buffer[: ports.ports[index].read_into(memoryview(buffer))])


def test_waiting_ends_at_the_first_reply_and_names_its_line():
    clock, ports, _ = two_buses()
    for port in ports.ports:
        port.write_packet(PING_1)
    assert ports.wait_for_bytes(10**9) == [1]
    assert clock.now_ns() == 1_000 + 220_000
    assert read(ports, 1) == PONG_1
    assert ports.wait_for_bytes(10**9) == [0]
    assert clock.now_ns() == 1_000 + 620_000
    assert read(ports, 0) == PONG_1


def test_waiting_ends_at_the_deadline():
    clock, ports, _ = two_buses()
    assert ports.wait_for_bytes(5_000) == []
    assert clock.now_ns() == 5_000
    assert ports.wait_for_bytes(100) == []  # the past: only a look
    assert clock.now_ns() == 5_000


def test_bytes_that_do_not_fit_stay_for_the_next_read():
    _, ports, _ = two_buses()
    ports.ports[0].write_packet(PING_1)
    ports.wait_for_bytes(10**9)
    small = bytearray(4)
    assert ports.ports[0].read_into(memoryview(small)) == 4
    assert ports.wait_for_bytes(10**9) == [0]
    assert bytes(small) + read(ports, 0) == PONG_1
    assert read(ports, 0) == b""


def test_an_unplugged_adapter_is_a_port_error():
    _, ports, virtual = two_buses()
    virtual.ports[0].unplug()
    assert ports.wait_for_bytes(10**9) == [0]
    with pytest.raises(PortError, match="bus left is unplugged"):
        ports.ports[0].write_packet(PING_1)
    with pytest.raises(PortError):
        read(ports, 0)
    ports.ports[1].write_packet(PING_1)


def test_a_planned_fault_happens_while_somebody_waits(make_line):
    line = make_line()
    line.bus.at(3_000_000, lambda: line.bus.inject_noise(b"\x55", 3_000_000))
    assert line.receive() == b"\x55"


def test_a_lost_line_is_back_when_its_adapter_is_and_delays_no_other_meanwhile():
    clock, ports, virtual = two_buses()
    virtual.ports[0].unplug()
    assert ports.wait_for_bytes(5_000) == [0]
    assert not ports.reopen(0)
    assert ports.wait_for_bytes(5_000) == []
    assert clock.now_ns() == 5_000
    with pytest.raises(PortError):
        ports.ports[0].write_packet(PING_1)
    virtual._buses[0].plug_in()
    assert ports.reopen(0)
    ports.ports[0].write_packet(PING_1)
    assert ports.wait_for_bytes(10**9) == [0]
    assert read(ports, 0) == PONG_1


def test_time_passes_on_a_lost_line():
    clock, ports, virtual = two_buses()
    (bus, _) = virtual._buses
    bus.unplug()
    assert not ports.reopen(0)
    bus.at(2_000_000, bus.plug_in)
    assert ports.wait_for_bytes(3_000_000) == []
    assert bus.plugged
    assert clock.now_ns() == 3_000_000
