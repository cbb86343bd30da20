"""Bytes written and read by hand with pyserial: in odd pieces, in heaps, amid rubbish.

Whether a piece comes within the longest gap is up to the machine, so a packet in pieces is sent until it is
answered; what is answered never depends on the pieces.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import serial
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.packets import packet1, packet2
from tests.kit.simulated_line import split_statuses

from dxlsim.simulation_plan import BusConfig, ServoConfig

RATE = 1_000_000
SEEDS = range(4)
BUSES = (
    *(
        BusConfig(name, RATE, (ServoConfig(1, "XM430-W350", 2.0),), 2.0)
        for name in ("pieces", "rubbish", "left", "flood")
    ),
    *(
        BusConfig(name, RATE, tuple(ServoConfig(each, "AX-12A", 2.0) for each in (1, 2)))
        for name in ("pieces of 1.0", "rubbish of 1.0", *(f"stream {seed}" for seed in SEEDS))
    ),
)
PING2, PING1, PONG1 = packet2(1, 1), packet1(1, 1), packet1(1, 0)
MODEL = (1020).to_bytes(2, "little")


@pytest.fixture
def open_serial(simulation: Any) -> Iterator[Callable[..., serial.Serial]]:
    opened: list[serial.Serial] = []

    def open_bus(name: str, *, hasty: bool = False) -> serial.Serial:
        if hasty:
            simulation.expect_haste(name)
        opened.append(serial.Serial(simulation.ports[name], RATE, timeout=DEADLINE_S))
        return opened[-1]

    yield open_bus
    for each in opened:
        each.close()


def insist(port: serial.Serial, data: bytes, size: int, count: int) -> bytes:
    """Send bytes in pieces of a size until so many bytes answer them, and nothing more."""
    port.timeout = 0.1

    def answered() -> bytes | None:
        port.reset_input_buffer()
        for start in range(0, len(data), size):
            port.write(data[start : start + size])
        answer = bytes(port.read(count))
        return answer if len(answer) == count else None

    return until(answered, "the answer")


@pytest.mark.parametrize("size", [1, 2, 3, 7, 9])
def test_an_instruction_in_pieces_is_one_instruction(open_serial: Any, size: int) -> None:
    (answer,) = split_statuses(insist(open_serial("pieces", hasty=True), PING2, size, 14), 2.0)
    assert (answer.servo_id, answer.error, answer.parameters[:2]) == (1, 0, MODEL)
    if size < len(PING1):
        assert insist(open_serial("pieces of 1.0", hasty=True), PING1, size, 6) == PONG1


@pytest.mark.parametrize("seed", SEEDS)
def test_a_stream_cut_anywhere_means_what_it_meant_whole(open_serial: Any, seed: int) -> None:
    chance, port = random.Random(seed), open_serial(f"stream {seed}", hasty=True)
    speeds, stream = {1: b"\0\0", 2: b"\0\0"}, b""
    for _ in range(60):
        servo_id = chance.choice((1, 2))
        speeds[servo_id] = chance.randrange(1024).to_bytes(2, "little")
        stream += packet1(0xFE, 0x83, 32, 2, servo_id, *speeds[servo_id])

    def spoken() -> bool:
        port.reset_input_buffer()
        rest = stream
        while rest:
            size = chance.randrange(1, 40)
            port.write(rest[:size])
            rest = rest[size:]
        return all(
            insist(port, packet1(each, 0x02, 32, 2), 8, 8)[5:7] == speed for each, speed in speeds.items()
        )

    assert any(spoken() for _ in range(20))  # again only if the machine made too long a pause


RUBBISH = b"\x00", b"\xff", b"\xff\xff", b"\xff\xff\xfd", b"\xff\xff\xfd\xfd", b"\xfd\x00\x01", b"dxlrun?\r\n"
RUBBISH_1 = b"\x00", b"\xff", b"\xff\xff\xff", b"\xfe\xff", b"AT\r\n"


@pytest.mark.parametrize("rubbish", RUBBISH, ids=bytes.hex)
def test_rubbish_before_an_instruction_is_passed_over(open_serial: Any, rubbish: bytes) -> None:
    port = open_serial("rubbish")
    port.write(rubbish + PING2)
    (answer,) = split_statuses(bytes(port.read(14)), 2.0)
    assert answer.parameters[:2] == MODEL


@pytest.mark.parametrize("rubbish", RUBBISH_1, ids=bytes.hex)
def test_rubbish_before_an_instruction_of_protocol_1_is_passed_over(open_serial: Any, rubbish: bytes) -> None:
    port = open_serial("rubbish of 1.0")
    port.write(rubbish + PING1)
    assert port.read(6) == PONG1


def test_a_host_that_leaves_amid_an_instruction_or_floods_does_no_harm(
    open_serial: Any, simulation: Any
) -> None:
    for size in range(1, len(PING2)):
        with serial.Serial(simulation.ports["left"], RATE) as port:
            port.write(PING2[:size])
    assert insist(open_serial("left", hasty=True), PING2, 10, 14)[:5] == b"\xff\xff\xfd\x00\x01"
    port = open_serial("flood", hasty=True)
    for _ in range(40):  # and never reads
        port.write(PING2 * 50)
    assert insist(port, PING2, 10, 14)[:5] == b"\xff\xff\xfd\x00\x01"
