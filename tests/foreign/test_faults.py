"""What a broken servo looks like through the maker's SDK; the faults are given as a user types them."""

from __future__ import annotations

from typing import Any

import pytest
from dynamixel_sdk import COMM_RX_CORRUPT, COMM_RX_TIMEOUT, COMM_SUCCESS
from tests.foreign.conftest import Item
from tests.kit.awaited import DEADLINE_S, until

from dxlsim.simulation_plan import BusConfig, ServoConfig

PROTOCOL = 2.0
ALERT = 0x80
TORQUE, HARDWARE_ERROR = Item(64, 1), Item(70, 1)
"""Of the X series."""
TORQUE_1, TORQUE_LIMIT_1 = Item(24, 1), Item(34, 2)
"""Of the AX series."""
SPOILT = {
    "corrupt servo=1": COMM_RX_CORRUPT,
    "truncate servo=1 keep=9": COMM_RX_CORRUPT,
    "lose servo=1": COMM_RX_TIMEOUT,
    "lose from=host": COMM_RX_TIMEOUT,
}
"""Faults, and what the SDK makes of the next answer."""
MODELS = {1: "AX-12A", 2: "XM430-W350"}
BUSES = [
    BusConfig(
        f"{name}{protocol}", 1_000_000, (ServoConfig(1, model, 2.0), ServoConfig(2, model, 2.0)), protocol
    )
    for name in ("overload", "overheat", "spoilt", "torn")
    for protocol, model in MODELS.items()
]
faults = pytest.mark.parametrize(
    ("fault", "bit", "words"), [("overload", 0x20, "Overload"), ("overheat", 0x04, "Overheat")]
)


@faults
def test_a_shutdown_takes_the_torque_and_alerts_in_every_answer(
    connect: Any, simulation: Any, fault: str, bit: int, words: str
) -> None:
    host = connect(f"{fault}2")
    host.write(1, TORQUE, 1)
    simulation.fault(f"{fault} servo=1 bus={fault}2")
    assert until(lambda: host.get(1, TORQUE) == (0, COMM_SUCCESS, ALERT))
    status, result, error = host.get(1, HARDWARE_ERROR)
    assert (status & bit, result, error) == (bit, COMM_SUCCESS, ALERT)
    assert "Hardware error" in host.sdk.getRxPacketError(error)
    assert host.ping(2) == 1020


@faults
def test_a_shutdown_of_protocol_1_takes_the_torque_limit(
    connect: Any, simulation: Any, fault: str, bit: int, words: str
) -> None:
    host = connect(f"{fault}1", 1.0)
    host.write(1, TORQUE_1, 1)
    simulation.fault(f"{fault} servo=1 bus={fault}1")
    assert until(lambda: host.get(1, TORQUE_LIMIT_1) == (0, COMM_SUCCESS, bit))
    assert host.get(1, TORQUE_1) == (1, COMM_SUCCESS, bit)
    assert words in host.sdk.getRxPacketError(bit)


def test_a_reboot_ends_a_shutdown(connect: Any, simulation: Any) -> None:
    host = connect("torn2")
    simulation.fault("overload servo=2 bus=torn2")
    assert until(lambda: host.get(2, HARDWARE_ERROR)[0] & 0x20 != 0)
    simulation.expect_refusals("torn2", 1)
    result, error = host.put(2, TORQUE, 1)
    assert (result, error & ALERT) == (COMM_SUCCESS, ALERT)
    assert host.get(2, TORQUE)[0] == 0
    assert host.sdk.reboot(host.port, 2)[0] == COMM_SUCCESS
    assert host.answers_again(2)
    host.write(2, TORQUE, 1)


@pytest.mark.parametrize(("fault", "result"), SPOILT.items(), ids=list(SPOILT))
@pytest.mark.parametrize("protocol", [1, 2])
def test_one_spoilt_answer_is_seen_and_the_next_is_good(
    connect: Any, simulation: Any, protocol: int, fault: str, result: int
) -> None:
    bus, servo_id = f"spoilt{protocol}", 3 if protocol == 1 else 7  # the address of the ID
    host = connect(bus, protocol)
    simulation.expect_haste(bus)
    simulation.fault(f"{fault} bus={bus}".replace("keep=9", f"keep={4 * protocol}"))
    if "servo=1" in fault:
        host.ping(2)  # what another one answers stays whole
    if fault != "corrupt servo=1":
        host.port.patience_ms = 30.0 if result == COMM_RX_TIMEOUT else 300.0
    assert host.sdk.readTxRx(host.port, 1, servo_id, 1)[1] == result
    host.port.patience_ms = DEADLINE_S * 1000
    assert host.sdk.readTxRx(host.port, 1, servo_id, 1) == ([1], COMM_SUCCESS, 0)
