"""What a broken servo looks like through the maker's SDK; the faults are given as a user types them."""

from __future__ import annotations

from typing import Any

import pytest
from dynamixel_sdk import (
    COMM_RX_CORRUPT,
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    Protocol1PacketHandler,
    Protocol2PacketHandler,
)
from tests.kit.awaited import DEADLINE_S, until

from dxlsim.simulation_plan import BusConfig, ServoConfig

ALERT = 0x80
TORQUE, HARDWARE_ERROR = 64, 70
"""Addresses of the X series."""
TORQUE_1, TORQUE_LIMIT_1 = 24, 34
"""Addresses of the AX series."""


def line(name: str, model: str, protocol: float) -> BusConfig:
    return BusConfig(name, 1_000_000, (ServoConfig(1, model, 2.0), ServoConfig(2, model, 2.0)), protocol)


SPOILT = {
    "corrupt servo=1": COMM_RX_CORRUPT,
    "truncate servo=1 keep=9": COMM_RX_CORRUPT,
    "lose servo=1": COMM_RX_TIMEOUT,
    "lose from=host": COMM_RX_TIMEOUT,
}
"""Faults, and what the SDK makes of the next answer."""
BUSES = (
    *(line(name, "XM430-W350", 2.0) for name in ("overload2", "overheat2", "voltage2", "spoilt2", "torn2")),
    *(line(name, "AX-12A", 1.0) for name in ("overload1", "overheat1", "voltage1", "spoilt1")),
)


@pytest.mark.parametrize(
    ("fault", "bit"), [("overload", 0x20), ("overheat", 0x04)], ids=["overload", "overheat"]
)
def test_a_shutdown_takes_the_torque_and_alerts_in_every_answer(
    open_port: Any, simulation: Any, fault: str, bit: int
) -> None:
    port, sdk = open_port(f"{fault}2"), Protocol2PacketHandler()
    assert sdk.write1ByteTxRx(port, 1, TORQUE, 1) == (COMM_SUCCESS, 0)
    simulation.fault(f"{fault} servo=1 bus={fault}2")
    assert until(lambda: sdk.read1ByteTxRx(port, 1, TORQUE) == (0, COMM_SUCCESS, ALERT))
    status, result, error = sdk.read1ByteTxRx(port, 1, HARDWARE_ERROR)
    assert (status & bit, result, error) == (bit, COMM_SUCCESS, ALERT)
    assert "Hardware error" in sdk.getRxPacketError(error)
    assert sdk.ping(port, 2) == (1020, COMM_SUCCESS, 0)


def test_a_voltage_that_no_shutdown_lists_alerts_and_leaves_the_torque(
    open_port: Any, simulation: Any
) -> None:
    port, sdk = open_port("voltage2"), Protocol2PacketHandler()
    assert sdk.write1ByteTxRx(port, 1, 63, 0x34) == (COMM_SUCCESS, 0)  # Shutdown without the voltage's bit
    assert sdk.write1ByteTxRx(port, 1, TORQUE, 1) == (COMM_SUCCESS, 0)
    simulation.fault("voltage volts=8.5 bus=voltage2")
    assert until(lambda: sdk.read1ByteTxRx(port, 1, TORQUE) == (1, COMM_SUCCESS, ALERT))
    simulation.fault("voltage volts=12 bus=voltage2")
    assert until(lambda: sdk.read1ByteTxRx(port, 1, TORQUE)[2] == 0)


def test_a_reboot_ends_a_shutdown(open_port: Any, simulation: Any) -> None:
    port, sdk = open_port("torn2"), Protocol2PacketHandler()
    simulation.expect_haste("torn2")
    simulation.fault("overload servo=2 bus=torn2")
    assert until(lambda: sdk.read1ByteTxRx(port, 2, HARDWARE_ERROR)[0] & 0x20 != 0)
    simulation.expect_refusals("torn2", 1)
    result, error = sdk.write1ByteTxRx(port, 2, TORQUE, 1)
    assert (result, error & ALERT) == (COMM_SUCCESS, ALERT)
    assert sdk.read1ByteTxRx(port, 2, TORQUE)[0] == 0
    assert sdk.reboot(port, 2)[0] == COMM_SUCCESS
    port.patience_ms = 30.0
    assert until(lambda: sdk.ping(port, 2) == (1020, COMM_SUCCESS, 0))
    port.patience_ms = DEADLINE_S * 1000
    assert sdk.write1ByteTxRx(port, 2, TORQUE, 1) == (COMM_SUCCESS, 0)


@pytest.mark.parametrize(
    ("fault", "words", "bit"),
    [("overload", "Overload", 0x20), ("overheat", "Overheat", 0x04)],
    ids=["overload", "overheat"],
)
def test_a_shutdown_of_protocol_1_takes_the_torque_limit(
    open_port: Any, simulation: Any, fault: str, words: str, bit: int
) -> None:
    port, sdk = open_port(f"{fault}1"), Protocol1PacketHandler()
    assert sdk.write1ByteTxRx(port, 1, TORQUE_1, 1) == (COMM_SUCCESS, 0)
    simulation.fault(f"{fault} servo=1 bus={fault}1")
    assert until(lambda: sdk.read2ByteTxRx(port, 1, TORQUE_LIMIT_1) == (0, COMM_SUCCESS, bit))
    torque, result, error = sdk.read1ByteTxRx(port, 1, TORQUE_1)
    assert (torque, result, error) == (1, COMM_SUCCESS, bit)
    assert words in sdk.getRxPacketError(error)


def test_a_voltage_error_of_protocol_1_comes_with_good_data(open_port: Any, simulation: Any) -> None:
    port, sdk = open_port("voltage1"), Protocol1PacketHandler()
    simulation.fault("voltage volts=5 servo=1 bus=voltage1")
    assert until(lambda: sdk.read1ByteTxRx(port, 1, 42) == (50, COMM_SUCCESS, 1))  # Present Voltage
    assert sdk.read2ByteTxRx(port, 1, 0) == (12, COMM_SUCCESS, 1)
    assert sdk.read2ByteTxRx(port, 2, 0) == (12, COMM_SUCCESS, 0)


@pytest.mark.parametrize(("fault", "result"), SPOILT.items(), ids=list(SPOILT))
@pytest.mark.parametrize("protocol", [1, 2])
def test_one_spoilt_answer_is_seen_and_the_next_is_good(
    open_port: Any, simulation: Any, protocol: int, fault: str, result: int
) -> None:
    port = open_port(f"spoilt{protocol}")
    sdk: Any = Protocol1PacketHandler() if protocol == 1 else Protocol2PacketHandler()
    simulation.expect_haste(f"spoilt{protocol}")
    simulation.fault(f"{fault} bus=spoilt{protocol}".replace("keep=9", f"keep={4 * protocol}"))
    if "servo=1" in fault:
        assert sdk.ping(port, 2)[1:] == (COMM_SUCCESS, 0)  # what another one answers stays whole
    if fault != "corrupt servo=1":
        port.patience_ms = 30.0 if result == COMM_RX_TIMEOUT else 300.0
    assert sdk.readTxRx(port, 1, 3 if protocol == 1 else 7, 1)[1] == result
    port.patience_ms = DEADLINE_S * 1000
    assert sdk.readTxRx(port, 1, 3 if protocol == 1 else 7, 1) == ([1], COMM_SUCCESS, 0)
