"""The same programs behind adapters that hold bytes back, hand them over in pieces, or echo."""

from typing import Any

import pytest
from dynamixel_sdk import COMM_SUCCESS, GroupSyncRead, GroupSyncWrite
from tests.foreign.conftest import Item

from dxlsim.simulation_plan import AdapterConfig, BusConfig, ServoConfig

PROTOCOL = 2.0
ADAPTERS = {
    "late": AdapterConfig(latency_timer_ns=16_000_000),
    "bytes": AdapterConfig(split="byte"),
    "pieces": AdapterConfig(split="random", seed=5),
    "echo": AdapterConfig(echo=True),
}
RATE = 1_000_000
X_SERVOS = tuple(ServoConfig(each, "XM430-W350", 2.0) for each in range(1, 7))
MX_SERVOS = tuple(ServoConfig(each, "MX-28", 2.0) for each in (1, 2))
PING = bytes.fromhex("ff ff fd 00 01 03 00 01 19 4e")  # e-Manual, Protocol 2.0, Ping
BUSES = (
    BusConfig("unset", 57_600, (ServoConfig(1, "XL430-W250", 1.0),), 2.0),
    *(BusConfig(f"{kind} 2", RATE, X_SERVOS, 2.0, adapter=each) for kind, each in ADAPTERS.items()),
    *(BusConfig(f"{kind} 1", RATE, MX_SERVOS, adapter=each) for kind, each in ADAPTERS.items()),
)
without_echo = pytest.mark.parametrize("kind", [each for each in ADAPTERS if each != "echo"])


@pytest.mark.parametrize("kind", ADAPTERS)
def test_the_sdk_reads_and_writes_in_protocol_2(connect: Any, kind: str) -> None:
    host, ids = connect(f"{kind} 2"), range(1, 7)
    assert [host.ping(each) for each in ids] == [1020] * 6
    writing = GroupSyncWrite(host.port, host.sdk, 112, 4)
    assert all(writing.addParam(each, [each, 0, 0, 0]) for each in ids)
    assert writing.txPacket() == COMM_SUCCESS
    reading = GroupSyncRead(host.port, host.sdk, 108, 8)
    assert all(reading.addParam(each) for each in ids)
    for ask in (reading.txRxPacket, reading.fastSyncRead):
        assert ask() == COMM_SUCCESS
        assert [reading.getData(each, 112, 4) for each in ids] == list(ids)


@without_echo
def test_the_sdk_reads_and_writes_in_protocol_1(connect: Any, kind: str) -> None:
    host, speed = connect(f"{kind} 1", 1.0), Item(32, 2)
    assert [host.ping(each) for each in (1, 2)] == [29] * 2
    host.write(1, speed, 777)
    assert host.read(1, speed) == 777


def test_an_echo_passes_for_an_answer_in_protocol_1(connect: Any) -> None:
    host = connect("echo 1", 1.0)
    _, result, error = host.sdk.txRxPacket(host.port, [0, 0, 1, 2, 1, 0])
    assert (result, error) == (COMM_SUCCESS, 1)  # the instruction byte, taken for a voltage error
    assert host.sdk.rxPacket(host.port)[0] == list(b"\xff\xff\1\2\0\xfc")  # what the servo said


def test_a_host_that_sets_no_rate_has_that_of_the_bus(simulation: Any) -> None:
    with open(simulation.ports["unset"], "r+b", buffering=0) as port:
        port.write(PING)
        assert port.read(1) == b"\xff"
