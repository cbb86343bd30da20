"""The same programs behind adapters that hold bytes back, hand them over in pieces, or echo.

A terminal has the rate that a host gives it, and servos at another one hear nothing.
"""

from __future__ import annotations

from typing import Any

import pytest
import rustypot
import serial
from dynamixel_sdk import (
    COMM_SUCCESS,
    GroupSyncRead,
    GroupSyncWrite,
    Protocol1PacketHandler,
    Protocol2PacketHandler,
)
from tests.kit.awaited import DEADLINE_S, until

from dxlsim.simulation_plan import AdapterConfig, BusConfig, ServoConfig

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

BUSES = (
    *(
        BusConfig(name, 57_600, (ServoConfig(1, "XL430-W250", 1.0),), 2.0)
        for name in ("strange", "unset", "odd")
    ),
    *(BusConfig(f"{kind} 2", RATE, X_SERVOS, 2.0, adapter=each) for kind, each in ADAPTERS.items()),
    *(BusConfig(f"{kind} 1", RATE, MX_SERVOS, adapter=each) for kind, each in ADAPTERS.items()),
    BusConfig("silent", RATE, X_SERVOS, 2.0),
    BusConfig("slot", RATE, X_SERVOS, 2.0, adapter=AdapterConfig(absent="slot")),
)


@pytest.mark.parametrize("kind", ADAPTERS)
def test_the_sdk_reads_and_writes_in_protocol_2(open_port: Any, kind: str) -> None:
    port, sdk = open_port(f"{kind} 2"), Protocol2PacketHandler()
    ids = range(1, 7)
    assert [sdk.ping(port, each) for each in ids] == [(1020, COMM_SUCCESS, 0)] * 6
    writing = GroupSyncWrite(port, sdk, 112, 4)
    assert all(writing.addParam(each, [each, 0, 0, 0]) for each in ids)
    assert writing.txPacket() == COMM_SUCCESS
    reading = GroupSyncRead(port, sdk, 108, 8)
    assert all(reading.addParam(each) for each in ids)
    for ask in (reading.txRxPacket, reading.fastSyncRead):
        assert ask() == COMM_SUCCESS
        assert [reading.getData(each, 112, 4) for each in ids] == list(ids)


@pytest.mark.parametrize("kind", [each for each in ADAPTERS if each != "echo"])
def test_the_sdk_reads_and_writes_in_protocol_1(open_port: Any, kind: str) -> None:
    port, sdk = open_port(f"{kind} 1"), Protocol1PacketHandler()
    assert [sdk.ping(port, each) for each in (1, 2)] == [(29, COMM_SUCCESS, 0)] * 2
    assert sdk.write2ByteTxRx(port, 1, 32, 777) == (COMM_SUCCESS, 0)
    assert sdk.read2ByteTxRx(port, 1, 32) == (777, COMM_SUCCESS, 0)


def test_an_echo_passes_for_an_answer_in_protocol_1(open_port: Any) -> None:
    port, sdk = open_port("echo 1"), Protocol1PacketHandler()
    _, result, error = sdk.txRxPacket(port, [0, 0, 1, 2, 1, 0])
    assert (result, error) == (COMM_SUCCESS, 1)  # the instruction byte, taken for a voltage error
    assert sdk.rxPacket(port)[0] == [0xFF, 0xFF, 1, 2, 0, 0xFC]  # what the servo said comes after it


@pytest.mark.parametrize("kind", [each for each in ADAPTERS if each != "echo"])
def test_rustypot_reads_and_writes_in_both_protocols(simulation: Any, kind: str) -> None:
    x_bus = rustypot.Xl430PyController(simulation.ports[f"{kind} 2"], RATE, DEADLINE_S)
    assert x_bus.sync_read_register(list(range(1, 7)), "model_number") == [1020] * 6
    assert x_bus.write_register_with_error(1, "led", 1) == 0
    x_bus.close()
    mx_bus = rustypot.MxPyController(simulation.ports[f"{kind} 1"], RATE, DEADLINE_S)
    assert mx_bus.read_register_with_error(2, "model_number") == (29, 0)
    assert mx_bus.write_register_with_error(2, "led", 1) == 0
    mx_bus.close()


def test_after_an_absent_servo_the_others_are_silent(simulation: Any) -> None:
    with serial.Serial(simulation.ports["silent"], RATE, timeout=DEADLINE_S) as port:
        port.write(SYNC_READ_OF_1_9_2)
        assert port.read(13)[4] == 1
        port.timeout = 0.05
        assert port.read(13) == b""


def test_after_an_absent_servo_the_others_answer_in_their_slots(simulation: Any) -> None:
    with serial.Serial(simulation.ports["slot"], RATE, timeout=DEADLINE_S) as port:
        port.write(SYNC_READ_OF_1_9_2)
        answers = port.read(26)
        assert (answers[4], answers[17]) == (1, 2)


def ask_again(port: serial.Serial) -> bytes:
    port.reset_input_buffer()
    port.write(PING)
    return bytes(port.read(14))


def test_a_host_at_another_rate_is_not_heard_until_it_finds_the_right_one(simulation: Any) -> None:
    with serial.Serial(simulation.ports["strange"], 38_400, timeout=0.05) as port:
        answers = []
        for rate in (38_400, 1_000_000, 4_500_000):
            port.baudrate = rate
            port.write(PING)
            answers.append(port.read(14))
        assert answers == [b"", b"", b""]
        simulation.expect_haste("strange")  # what it wrote last may be read at the next rate
        port.baudrate = 57_600
        answer = until(lambda: ask_again(port))
        assert answer.startswith(b"\xff\xff\xfd\x00\x01")


def test_a_host_that_sets_no_rate_has_that_of_the_bus(simulation: Any) -> None:
    with open(simulation.ports["unset"], "r+b", buffering=0) as port:
        port.write(PING)
        assert port.read(1) == b"\xff"


def test_a_rate_within_three_percent_is_near_enough(simulation: Any) -> None:
    with serial.Serial(simulation.ports["odd"], 56_500, timeout=DEADLINE_S) as port:
        port.write(PING)
        assert len(port.read(14)) == 14
