"""A terminal has the rate that a host gives it, and servos at another one hear nothing."""

from __future__ import annotations

import time
from typing import Any

import serial

from dxlrun.simulation import BusConfig, ServoConfig

BUSES = tuple(
    BusConfig(name, 57_600, (ServoConfig(1, "XL430-W250", 1.0),), 2.0) for name in ("strange", "unset", "odd")
)
PING = bytes.fromhex("ff ff fd 00 01 03 00 01 19 4e")  # e-Manual, Protocol 2.0, Ping
PATIENCE_S = 20.0


def ask_again(port: serial.Serial) -> bytes:
    port.reset_input_buffer()
    port.write(PING)
    return bytes(port.read(14))


def test_a_host_at_another_rate_is_not_heard_until_it_finds_the_right_one(simulation: Any) -> None:
    deadline = time.monotonic() + PATIENCE_S
    with serial.Serial(simulation.ports["strange"], 38_400, timeout=0.05) as port:
        answers = []
        for rate in (38_400, 1_000_000, 4_500_000):
            port.baudrate = rate
            port.write(PING)
            answers.append(port.read(14))
        assert answers == [b"", b"", b""]
        simulation.expect_haste("strange")  # what it wrote last may be read at the next rate
        port.baudrate = 57_600
        while (answer := ask_again(port)) == b"":
            assert time.monotonic() < deadline
        assert answer.startswith(b"\xff\xff\xfd\x00\x01")


def test_a_host_that_sets_no_rate_has_that_of_the_bus(simulation: Any) -> None:
    with open(simulation.ports["unset"], "r+b", buffering=0) as port:
        port.write(PING)
        assert port.read(1) == b"\xff"


def test_a_rate_within_three_percent_is_near_enough(simulation: Any) -> None:
    with serial.Serial(simulation.ports["odd"], 56_500, timeout=PATIENCE_S) as port:
        port.write(PING)
        assert len(port.read(14)) == 14
