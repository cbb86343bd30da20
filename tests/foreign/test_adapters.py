"""The same programs behind adapters that hold bytes back, hand them over in pieces, or echo.

A terminal has the rate that a host gives it, and servos at another one hear nothing.
"""

from typing import Any

import pytest
import serial
from dynamixel_sdk import COMM_SUCCESS, GroupSyncRead, GroupSyncWrite
from tests.foreign.conftest import Item
from tests.kit.awaited import DEADLINE_S, until

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
SYNC_READ_OF_1_9_2 = bytes.fromhex("ff ff fd 00 fe 0a 00 82 00 00 02 00 01 09 02 7c db")
PING = bytes.fromhex("ff ff fd 00 01 03 00 01 19 4e")  # e-Manual, Protocol 2.0, Ping
STRANGERS = ("strange", "unset", "odd")
BUSES = (
    *(BusConfig(name, 57_600, (ServoConfig(1, "XL430-W250", 1.0),), 2.0) for name in STRANGERS),
    *(BusConfig(f"{kind} 2", RATE, X_SERVOS, 2.0, adapter=each) for kind, each in ADAPTERS.items()),
    *(BusConfig(f"{kind} 1", RATE, MX_SERVOS, adapter=each) for kind, each in ADAPTERS.items()),
    BusConfig("silent", RATE, X_SERVOS, 2.0),
    BusConfig("slot", RATE, X_SERVOS, 2.0, adapter=AdapterConfig(absent="slot")),
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


@pytest.mark.parametrize(("bus", "ids"), [("silent", [1]), ("slot", [1, 2])])
def test_after_an_absent_servo_the_others_are_silent_or_answer_in_their_slots(
    simulation: Any, bus: str, ids: list[int]
) -> None:
    with serial.Serial(simulation.ports[bus], RATE, timeout=DEADLINE_S) as port:
        port.write(SYNC_READ_OF_1_9_2)
        assert [port.read(13)[4] for _ in ids] == ids
        port.timeout = 0.05
        assert port.read(13) == b""


def test_a_host_at_another_rate_is_not_heard_until_it_finds_the_right_one(simulation: Any) -> None:
    with serial.Serial(simulation.ports["strange"], 38_400, timeout=0.05) as port:

        def ask() -> bytes:
            port.reset_input_buffer()
            port.write(PING)
            return bytes(port.read(14))

        for rate in (38_400, 1_000_000, 4_500_000):
            port.baudrate = rate
            assert ask() == b""
        simulation.expect_haste("strange")  # what it wrote last may be read at the next rate
        port.baudrate = 57_600
        assert until(ask).startswith(b"\xff\xff\xfd\x00\x01")


def test_a_host_that_sets_no_rate_has_that_of_the_bus(simulation: Any) -> None:
    with open(simulation.ports["unset"], "r+b", buffering=0) as port:
        port.write(PING)
        assert port.read(1) == b"\xff"


def test_a_rate_within_three_percent_is_near_enough(simulation: Any) -> None:
    with serial.Serial(simulation.ports["odd"], 56_500, timeout=DEADLINE_S) as port:
        port.write(PING)
        assert len(port.read(14)) == 14
