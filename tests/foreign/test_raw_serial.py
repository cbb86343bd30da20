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
from tests.kit.simulated_line import Answer, split_statuses

from dxlsim.simulation_plan import BusConfig, ServoConfig

RATE = 1_000_000
SEEDS = range(4)
COUNTS = {"pieces": 1, "heap": 1, "rubbish": 1, "many": 12, "stuffed": 1, "left": 1, "flood": 1, "long": 1}
BUSES = (
    *(
        BusConfig(name, RATE, tuple(ServoConfig(n, "XM430-W350", 2.0) for n in range(1, count + 1)), 2.0)
        for name, count in COUNTS.items()
    ),
    *(
        BusConfig(name, RATE, tuple(ServoConfig(each, "AX-12A", 2.0) for each in (1, 2)))
        for name in ("pieces of 1.0", "rubbish of 1.0", *(f"stream {seed}" for seed in SEEDS))
    ),
)
PING2, PING1, PONG1 = packet2(1, 1), packet1(1, 1), packet1(1, 0)
PONG2 = b"\x00\xfc\x03"
"""Error, and model 1020; then the firmware."""


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


def status2(port: serial.Serial, size: int) -> Answer:
    """Return one whole status packet of a size."""
    (answer,) = split_statuses(bytes(port.read(size)), 2.0)
    return answer


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
    assert (answer.servo_id, answer.error, answer.parameters[:2]) == (1, 0, PONG2[1:])
    if size < len(PING1):
        assert insist(open_serial("pieces of 1.0", hasty=True), PING1, size, 6) == PONG1


def test_a_heap_of_instructions_in_one_write_is_obeyed_in_order(open_serial: Any) -> None:
    port, address = open_serial("heap"), b"\x70\x00\x04\x00"  # Profile Velocity; sync writes are not answered
    heap = [packet2(0xFE, 0x83, address + b"\x01" + value.to_bytes(4, "little")) for value in range(1, 101)]
    port.write(b"".join(heap) + packet2(1, 0x02, address))
    assert status2(port, 15) == (1, 0, (100).to_bytes(4, "little"))


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


@pytest.mark.parametrize(
    "rubbish",
    [b"\x00", b"\xff", b"\xff\xff", b"\xff\xff\xfd", b"\xff\xff\xfd\xfd", b"\xfd\x00\x01", b"dxlrun?\r\n"],
    ids=bytes.hex,
)
def test_rubbish_before_an_instruction_is_passed_over(open_serial: Any, rubbish: bytes) -> None:
    port = open_serial("rubbish")
    port.write(rubbish + PING2)
    assert status2(port, 14).parameters[:2] == PONG2[1:]


@pytest.mark.parametrize(
    "rubbish", [b"\x00", b"\xff", b"\xff\xff\xff", b"\xfe\xff", b"AT\r\n"], ids=bytes.hex
)
def test_rubbish_before_an_instruction_of_protocol_1_is_passed_over(open_serial: Any, rubbish: bytes) -> None:
    port = open_serial("rubbish of 1.0")
    port.write(rubbish + PING1)
    assert port.read(6) == PONG1


@pytest.mark.parametrize("size", [1, 3, 17, 64, 1000])
def test_many_answers_read_in_pieces_are_the_same_bytes(open_serial: Any, size: int) -> None:
    port, whole = open_serial("many"), b""
    port.write(packet2(0xFE, 0x82, b"\x00\x00\x40\x00" + bytes(range(1, 13))))  # the EEPROM of all
    while len(whole) < 12 * 75:
        piece = port.read(min(size, 12 * 75 - len(whole)))
        assert piece
        whole += bytes(piece)
    answers = split_statuses(whole, 2.0)
    assert [answer.servo_id for answer in answers] == list(range(1, 13))
    for answer in answers:
        assert (answer.parameters[:2], len(answer.parameters)) == (PONG2[1:], 64)
        assert answer.parameters[7] == answer.servo_id
    assert port.in_waiting == 0


def test_data_that_look_like_a_header_are_stuffed_both_ways(open_serial: Any) -> None:
    port = open_serial("stuffed")
    tricky = bytes.fromhex("ff ff ff ff fd 00 00 00")  # Goal Velocity -1, Profile Acceleration 253
    port.write(packet2(1, 0x03, b"\x68\x00" + tricky))
    assert status2(port, 11) == (1, 0, b"")
    port.write(packet2(1, 0x02, b"\x68\x00\x08\x00"))
    status = bytes(port.read(20))
    assert status == packet2(1, 0x55, b"\x00" + tricky)
    assert status[5:7] == b"\x0d\x00"  # the length counts the stuffing


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


def test_the_longest_instruction_is_answered_with_an_error(open_serial: Any, simulation: Any) -> None:
    port = open_serial("long")
    simulation.expect_refusals("long", 1)
    port.write(packet2(1, 0x03, b"\x40\x00" + bytes(2000)))
    assert status2(port, 11).error & 0x7F != 0
    port.write(PING2)
    assert status2(port, 14).error == 0
