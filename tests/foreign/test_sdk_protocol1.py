"""The examples of the maker's SDK for Protocol 1.0, each as a test; what they print is asserted here.

Its group for bulk reads raises TypeError in this protocol: the two halves of it are called instead.
"""

from typing import Any

import pytest
from dynamixel_sdk import COMM_RX_TIMEOUT, COMM_SUCCESS, GroupBulkRead, GroupSyncWrite
from tests.foreign.conftest import Item

from dxlsim.simulation_plan import BusConfig, ServoConfig

PROTOCOL = 1.0
AX12, MX28 = 12, 29
"""Model numbers (e-Manual, control tables, Model Number (0))."""
CW_LIMIT, TORQUE, LED, GOAL, PRESENT = Item(6, 2), Item(24, 1), Item(25, 1), Item(30, 2), Item(36, 2)
NEAR = 10
"""Ticks that the examples call arrived."""
MIDDLE = 2.617994
"""150 degrees: tick 512 of an AX, 1707 of an MX."""
LINES = {
    "read_write": {1: "AX-12A", 2: "MX-28"},
    "sync": {1: "AX-12A", 2: "AX-12A"},
    "bulk": {1: "MX-28", 2: "MX-28", 3: "AX-12A"},
    "refused": {1: "AX-12A", 2: "MX-28"},
}
BUSES = [
    BusConfig(name, 1_000_000, tuple(ServoConfig(each, model, MIDDLE) for each, model in models.items()))
    for name, models in LINES.items()
]


def test_ping_tells_the_model(connect: Any) -> None:
    host = connect("read_write")
    assert [host.ping(each) for each in (1, 2)] == [AX12, MX28]
    assert host.is_silent(3)


@pytest.mark.parametrize(("servo_id", "unit"), [(1, 300 / 1023), (2, 360 / 4096)])
def test_read_write_moves_the_servo_to_its_goal(connect: Any, servo_id: int, unit: float) -> None:
    host = connect("read_write")
    host.write(servo_id, TORQUE, 1)
    start = host.read(servo_id, PRESENT)
    assert abs(start * unit - 150.0) < 1.0
    for goal in (start + 60, start):
        host.write(servo_id, GOAL, goal)
        assert host.near(servo_id, PRESENT, goal, NEAR)
    host.write(servo_id, TORQUE, 0)


def test_sync_write_moves_two_servos_and_none_answers(connect: Any) -> None:
    host, goals = connect("sync"), {1: 560, 2: 470}
    writing = GroupSyncWrite(host.port, host.sdk, *GOAL)
    assert all(writing.addParam(each, goal.to_bytes(2, "little")) for each, goal in goals.items())
    assert writing.txPacket() == COMM_SUCCESS
    for each, goal in goals.items():
        assert host.near(each, PRESENT, goal, NEAR)
        assert host.read(each, TORQUE) == 1


def bulk_read(host: Any, *entries: tuple[int, Item]) -> GroupBulkRead:
    reading = GroupBulkRead(host.port, host.sdk)
    assert all(reading.addParam(servo_id, *item) for servo_id, item in entries)
    reading.makeParam()
    assert host.sdk.bulkReadTx(host.port, reading.param, len(reading.param)) == COMM_SUCCESS
    return reading


def test_bulk_read_of_different_items(connect: Any) -> None:
    host = connect("bulk")
    host.write(2, LED, 1)
    reading = bulk_read(host, (1, PRESENT), (2, LED))
    assert reading.rxPacket() == COMM_SUCCESS
    assert abs(reading.getData(1, *PRESENT) - 1707) <= NEAR
    assert reading.getData(2, *LED) == 1


def test_an_ax_does_not_know_bulk_read(connect: Any, simulation: Any) -> None:
    host = connect("bulk")
    simulation.expect_refusals("bulk", 1)
    bulk_read(host, (1, PRESENT), (3, PRESENT))
    assert host.sdk.readRx(host.port, 1, 2)[1] == COMM_SUCCESS
    host.port.patience_ms = 30.0
    host.port.setPacketTimeout(8)
    assert host.sdk.readRx(host.port, 3, 2)[1] == COMM_RX_TIMEOUT


def test_what_the_manual_forbids_gets_its_error_bits(connect: Any, simulation: Any) -> None:
    host = connect("refused")
    host.write(2, CW_LIMIT, 100)
    assert "Angle limit" in host.refused(2, GOAL, 50)
    assert "Out of range" in host.refused(1, LED, 2)
    assert "Out of range" in host.refused(1, PRESENT, 0)  # read-only
    assert host.ping(1) == AX12  # an error is told once, with its instruction
    simulation.expect_refusals("refused", 1)
    _, result, error = host.sdk.txRxPacket(host.port, [0, 0, 1, 2, 5, 0])  # action, and nothing is registered
    assert result == COMM_SUCCESS
    assert "Instruction code" in host.sdk.getRxPacketError(error)
