"""The maker's SDK as the host, behind adapters that hold bytes back, hand them over in pieces, or echo.

It is asked only where it is right: it stuffs nothing that it sends, loses a sync read in which one servo is
silent, and in Protocol 1.0 its bulk read raises TypeError: the two halves of it are called instead.
"""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from dynamixel_sdk import (
    COMM_SUCCESS,
    GroupBulkRead,
    GroupSyncRead,
    GroupSyncWrite,
    Protocol1PacketHandler,
    Protocol2PacketHandler,
)
from tests.foreign.conftest import PatientPort

from dxlsim.simulation_plan import AdapterConfig, BusConfig, ServoConfig

ADAPTERS = {
    "late": AdapterConfig(latency_timer_ns=16_000_000),
    "bytes": AdapterConfig(split="byte"),
    "pieces": AdapterConfig(split="random", seed=5),
    "echo": AdapterConfig(echo=True),
}
RATE = 1_000_000
SPEED = 32, 2
"""Moving Speed of an MX: address and size."""
X_SERVOS = tuple(ServoConfig(each, "XM430-W350", 2.0) for each in range(1, 7))
MX_SERVOS = tuple(ServoConfig(each, "MX-28", 2.0) for each in (1, 2))
PING = bytes.fromhex("ff ff fd 00 01 03 00 01 19 4e")  # e-Manual, Protocol 2.0, Ping
BUSES = (
    BusConfig("unset", 57_600, (ServoConfig(1, "XL430-W250", 1.0),), 2.0),
    *(BusConfig(f"{kind} 2", RATE, X_SERVOS, 2.0, adapter=each) for kind, each in ADAPTERS.items()),
    *(BusConfig(f"{kind} 1", RATE, MX_SERVOS, adapter=each) for kind, each in ADAPTERS.items()),
)
without_echo = pytest.mark.parametrize("kind", [each for each in ADAPTERS if each != "echo"])


@pytest.fixture
def connect(simulation: Any) -> Iterator[Callable[[str], tuple[PatientPort, Any]]]:
    """Open a bus as the SDK's examples do."""
    opened: list[PatientPort] = []

    def open_bus(bus: str) -> tuple[PatientPort, Any]:
        opened.append(PatientPort(simulation.ports[bus]))
        assert opened[-1].setBaudRate(RATE)
        return opened[-1], Protocol1PacketHandler() if bus.endswith("1") else Protocol2PacketHandler()

    yield open_bus
    for port in opened:
        port.closePort()


@pytest.mark.parametrize("kind", ADAPTERS)
def test_the_sdk_reads_and_writes_in_protocol_2(connect: Any, kind: str) -> None:
    (port, sdk), ids = connect(f"{kind} 2"), range(1, 7)
    assert [sdk.ping(port, each) for each in ids] == [(1020, COMM_SUCCESS, 0)] * 6
    writing = GroupSyncWrite(port, sdk, 112, 4)
    assert all(writing.addParam(each, [each, 0, 0, 0]) for each in ids)
    assert writing.txPacket() == COMM_SUCCESS
    reading = GroupSyncRead(port, sdk, 108, 8)
    assert all(reading.addParam(each) for each in ids)
    for ask in (reading.txRxPacket, reading.fastSyncRead):
        assert ask() == COMM_SUCCESS
        assert [reading.getData(each, 112, 4) for each in ids] == list(ids)


@without_echo
def test_the_sdk_reads_and_writes_in_protocol_1(connect: Any, kind: str) -> None:
    port, sdk = connect(f"{kind} 1")
    assert [sdk.ping(port, each) for each in (1, 2)] == [(29, COMM_SUCCESS, 0)] * 2
    assert sdk.write2ByteTxRx(port, 1, SPEED[0], 777) == (COMM_SUCCESS, 0)
    assert sdk.read2ByteTxRx(port, 1, SPEED[0]) == (777, COMM_SUCCESS, 0)
    reading = GroupBulkRead(port, sdk)
    assert all(reading.addParam(each, *SPEED) for each in (1, 2))
    reading.makeParam()
    assert sdk.bulkReadTx(port, reading.param, len(reading.param)) == COMM_SUCCESS
    assert reading.rxPacket() == COMM_SUCCESS
    assert [reading.getData(each, *SPEED) for each in (1, 2)] == [777, 0]


def test_an_echo_passes_for_an_answer_in_protocol_1(connect: Any) -> None:
    port, sdk = connect("echo 1")
    _, result, error = sdk.txRxPacket(port, [0, 0, 1, 2, 1, 0])
    assert (result, error) == (COMM_SUCCESS, 1)  # the instruction byte, taken for a voltage error
    assert sdk.rxPacket(port)[0] == list(b"\xff\xff\1\2\0\xfc")  # what the servo said


def test_a_host_that_sets_no_rate_has_that_of_the_bus(simulation: Any) -> None:
    with open(simulation.ports["unset"], "r+b", buffering=0) as port:
        port.write(PING)
        assert port.read(1) == b"\xff"
