"""Bytes written and read by hand with pyserial: in odd pieces, in heaps, amid rubbish.

Whether a piece comes within the longest gap is up to the machine, so a packet in pieces is sent until it is
answered; what is answered never depends on the pieces.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from typing import Any

import pytest
import serial
from tests.kit.awaited import DEADLINE_S, until
from tests.kit.packets import crc, packet1, packet2

from dxlsim.simulation_plan import BusConfig, ServoConfig

RATE = 1_000_000


def line2(name: str, count: int = 1) -> BusConfig:
    servos = tuple(ServoConfig(each, "XM430-W350", 2.0) for each in range(1, count + 1))
    return BusConfig(name, RATE, servos, 2.0)


def line1(name: str) -> BusConfig:
    return BusConfig(name, RATE, tuple(ServoConfig(each, "AX-12A", 2.0) for each in (1, 2)))


SEEDS = range(4)
BUSES = (
    line2("pieces"),
    line1("pieces of 1.0"),
    line2("heap"),
    *(line1(f"stream {seed}") for seed in SEEDS),
    line2("rubbish"),
    line1("rubbish of 1.0"),
    line2("many", 12),
    line2("stuffed"),
    line2("left"),
    line2("flood"),
    line2("long"),
)
PING2 = bytes.fromhex("ff ff fd 00 01 03 00 01 19 4e")
PING1 = bytes.fromhex("ff ff 01 02 01 fb")
PONG1 = bytes.fromhex("ff ff 01 02 00 fc")
"""e-Manual, Protocol 2.0 and Protocol 1.0, Ping."""


@pytest.fixture
def open_serial(simulation: Any) -> Iterator[Any]:
    opened: list[serial.Serial] = []

    def open_bus(name: str) -> serial.Serial:
        opened.append(serial.Serial(simulation.ports[name], RATE, timeout=DEADLINE_S))
        return opened[-1]

    yield open_bus
    for each in opened:
        each.close()


def status2(port: serial.Serial) -> bytes:
    """Return one status packet whose CRC is right."""
    head = port.read(7)
    assert head[:4] == b"\xff\xff\xfd\x00"
    whole = bytes(head + port.read(int.from_bytes(head[5:], "little")))
    assert whole[7] == 0x55
    assert crc(whole[:-2]) == int.from_bytes(whole[-2:], "little")
    return whole


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
def test_an_instruction_in_pieces_is_one_instruction(open_serial: Any, simulation: Any, size: int) -> None:
    simulation.expect_haste("pieces")
    answer = insist(open_serial("pieces"), PING2, size, 14)
    assert answer[:11] == bytes.fromhex("ff ff fd 00 01 07 00 55 00 fc 03")  # model 1020
    assert crc(answer[:-2]) == int.from_bytes(answer[-2:], "little")


@pytest.mark.parametrize("size", [1, 2, 3, 5])
def test_an_instruction_of_protocol_1_in_pieces_is_one_too(
    open_serial: Any, simulation: Any, size: int
) -> None:
    simulation.expect_haste("pieces of 1.0")
    assert insist(open_serial("pieces of 1.0"), PING1, size, 6) == PONG1


def test_a_heap_of_instructions_in_one_write_is_obeyed_in_order(open_serial: Any) -> None:
    port = open_serial("heap")
    address = (112).to_bytes(2, "little")  # Profile Velocity; sync writes are not answered
    heap = [
        packet2(0xFE, 0x83, address + b"\x04\x00\x01" + value.to_bytes(4, "little"))
        for value in range(1, 101)
    ]
    port.write(b"".join(heap) + packet2(1, 0x02, address + b"\x04\x00"))
    assert status2(port)[8:-2] == b"\x00" + (100).to_bytes(4, "little")


@pytest.mark.parametrize("seed", SEEDS)
def test_a_stream_cut_anywhere_means_what_it_meant_whole(
    open_serial: Any, simulation: Any, seed: int
) -> None:
    simulation.expect_haste(f"stream {seed}")
    chance = random.Random(seed)
    port = open_serial(f"stream {seed}")
    speeds = {1: 0, 2: 0}
    stream = b""
    for _ in range(60):
        servo_id, speed = chance.choice((1, 2)), chance.randrange(1024)
        speeds[servo_id] = speed
        stream += packet1(0xFE, 0x83, 32, 2, servo_id, *speed.to_bytes(2, "little"))

    def spoken() -> bool:
        port.reset_input_buffer()
        rest = stream
        while rest:
            size = chance.randrange(1, 40)
            port.write(rest[:size])
            rest = rest[size:]
        return all(
            insist(port, packet1(each, 0x02, 32, 2), 8, 8)[5:7] == speed.to_bytes(2, "little")
            for each, speed in speeds.items()
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
    assert status2(port)[4:10] == bytes.fromhex("01 07 00 55 00 fc")


@pytest.mark.parametrize(
    "rubbish", [b"\x00", b"\xff", b"\xff\xff\xff", b"\xfe\xff", b"AT\r\n"], ids=bytes.hex
)
def test_rubbish_before_an_instruction_of_protocol_1_is_passed_over(open_serial: Any, rubbish: bytes) -> None:
    port = open_serial("rubbish of 1.0")
    port.write(rubbish + PING1)
    assert port.read(6) == PONG1


@pytest.mark.parametrize("size", [1, 3, 17, 64, 1000])
def test_many_answers_read_in_pieces_are_the_same_bytes(open_serial: Any, size: int) -> None:
    port = open_serial("many")
    port.write(packet2(0xFE, 0x82, b"\x00\x00\x40\x00" + bytes(range(1, 13))))  # the EEPROM of all
    whole = b""
    while len(whole) < 12 * 75:
        piece = port.read(min(size, 12 * 75 - len(whole)))
        assert piece
        whole += bytes(piece)
    for servo_id in range(1, 13):
        status, whole = whole[:75], whole[75:]
        assert status[:9] == b"\xff\xff\xfd\x00" + bytes((servo_id,)) + b"\x44\x00\x55\x00"
        assert status[9:11] == b"\xfc\x03"
        assert status[16] == servo_id
        assert crc(status[:-2]) == int.from_bytes(status[-2:], "little")
    assert port.in_waiting == 0


def test_data_that_look_like_a_header_are_stuffed_both_ways(open_serial: Any) -> None:
    port = open_serial("stuffed")
    tricky = bytes.fromhex("ff ff ff ff fd 00 00 00")  # Goal Velocity -1, Profile Acceleration 253
    port.write(packet2(1, 0x03, b"\x68\x00" + tricky))
    assert status2(port)[8] == 0
    port.write(packet2(1, 0x02, b"\x68\x00\x08\x00"))
    status = status2(port)
    assert status == packet2(1, 0x55, b"\x00" + tricky)
    assert status[5:7] == b"\x0d\x00"  # the length counts the stuffing


def test_a_host_that_leaves_amid_an_instruction_does_no_harm(open_serial: Any, simulation: Any) -> None:
    simulation.expect_haste("left")
    for size in range(1, len(PING2)):
        with serial.Serial(simulation.ports["left"], RATE) as port:
            port.write(PING2[:size])
    assert insist(open_serial("left"), PING2, 10, 14)[:5] == b"\xff\xff\xfd\x00\x01"


def test_a_host_that_floods_and_never_reads_is_heard_when_it_behaves(
    open_serial: Any, simulation: Any
) -> None:
    simulation.expect_haste("flood")
    port = open_serial("flood")
    for _ in range(40):
        port.write(PING2 * 50)
    assert insist(port, PING2, 10, 14)[:5] == b"\xff\xff\xfd\x00\x01"


def test_the_longest_instruction_is_answered_with_an_error(open_serial: Any, simulation: Any) -> None:
    port = open_serial("long")
    simulation.expect_refusals("long", 1)
    port.write(packet2(1, 0x03, b"\x40\x00" + bytes(2000)))
    assert status2(port)[8] & 0x7F != 0
    port.write(PING2)
    assert status2(port)[8] == 0
