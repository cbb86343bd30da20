"""The examples of the maker's SDK for Protocol 1.0, each as a test; what they print is asserted here.

Its group for bulk reads raises TypeError in this protocol: the two halves of it are called instead.
"""

from __future__ import annotations

from typing import Any

import pytest
from dynamixel_sdk import COMM_RX_TIMEOUT, COMM_SUCCESS, GroupBulkRead, GroupSyncWrite, Protocol1PacketHandler
from tests.kit.awaited import DEADLINE_S, until

from dxlsim.simulation_plan import BusConfig, ServoConfig

AX12, MX28 = 12, 29
"""Model numbers (e-Manual, control tables, Model Number (0))."""
ID, BAUD_RATE, RETURN_DELAY, CW_LIMIT, CCW_LIMIT = 3, 4, 5, 6, 8
TORQUE, LED, GOAL, SPEED, PRESENT, PRESENT_SPEED, REGISTERED, LOCK = 24, 25, 30, 32, 36, 38, 44, 47
"""Addresses of the AX and MX series."""
NEAR = 10
"""Ticks that the examples call arrived."""
BROADCAST = 0xFE
MIDDLE = 2.617994
"""150 degrees: tick 512 of an AX, 1707 of an MX."""


def line(name: str, *models: str) -> BusConfig:
    servos = tuple(ServoConfig(each, model, MIDDLE) for each, model in enumerate(models, start=1))
    return BusConfig(name, 1_000_000, servos)


BUSES = (
    line("read_write", "AX-12A", "MX-28"),
    line("sync", "AX-12A", "AX-12A"),
    line("bulk", "MX-28", "MX-28", "AX-12A"),
    line("refused", "AX-12A", "MX-28"),
    line("registered", "AX-12A", "AX-12A"),
    line("wheel", "AX-12A"),
    line("renamed", "AX-12A", "MX-28"),
    BusConfig("reset", 1_000_000, (ServoConfig(7, "AX-12A", 2.0), ServoConfig(8, "MX-28", 2.0))),
)


@pytest.fixture
def sdk() -> Any:
    return Protocol1PacketHandler()


def good(*results: tuple[int, int]) -> bool:
    return all(each == (COMM_SUCCESS, 0) for each in results)


def test_ping_tells_the_model(open_port: Any, sdk: Any) -> None:
    port = open_port("read_write")
    assert [sdk.ping(port, each) for each in (1, 2)] == [(AX12, COMM_SUCCESS, 0), (MX28, COMM_SUCCESS, 0)]
    port.patience_ms = 30.0
    assert sdk.ping(port, 3)[1] == COMM_RX_TIMEOUT


@pytest.mark.parametrize(("servo_id", "unit"), [(1, 300 / 1023), (2, 360 / 4096)])
def test_read_write_moves_the_servo_to_its_goal(open_port: Any, sdk: Any, servo_id: int, unit: float) -> None:
    port = open_port("read_write")
    assert good(sdk.write1ByteTxRx(port, servo_id, TORQUE, 1))
    start, result, error = sdk.read2ByteTxRx(port, servo_id, PRESENT)
    assert (result, error) == (COMM_SUCCESS, 0)
    assert abs(start * unit - 150.0) < 1.0
    for goal in (start + 60, start):
        assert good(sdk.write2ByteTxRx(port, servo_id, GOAL, goal))
        assert until(lambda goal=goal: abs(sdk.read2ByteTxRx(port, servo_id, PRESENT)[0] - goal) <= NEAR)
    assert good(sdk.write1ByteTxRx(port, servo_id, TORQUE, 0))


def test_sync_write_moves_two_servos_and_none_answers(open_port: Any, sdk: Any) -> None:
    port = open_port("sync")
    goals = {1: 560, 2: 470}
    writing = GroupSyncWrite(port, sdk, GOAL, 2)
    assert all(writing.addParam(each, goal.to_bytes(2, "little")) for each, goal in goals.items())
    assert writing.txPacket() == COMM_SUCCESS
    for each, goal in goals.items():
        assert until(lambda n=each, goal=goal: abs(sdk.read2ByteTxRx(port, n, PRESENT)[0] - goal) <= NEAR)
        assert sdk.read1ByteTxRx(port, each, TORQUE) == (1, COMM_SUCCESS, 0)


def test_bulk_read_of_different_items(open_port: Any, sdk: Any) -> None:
    port = open_port("bulk")
    assert good(sdk.write1ByteTxRx(port, 2, LED, 1))
    reading = GroupBulkRead(port, sdk)
    assert reading.addParam(1, PRESENT, 2)
    assert reading.addParam(2, LED, 1)
    reading.makeParam()
    assert sdk.bulkReadTx(port, reading.param, len(reading.param)) == COMM_SUCCESS
    assert reading.rxPacket() == COMM_SUCCESS
    assert abs(reading.getData(1, PRESENT, 2) - 1707) <= NEAR
    assert reading.getData(2, LED, 1) == 1


def test_an_ax_does_not_know_bulk_read(open_port: Any, sdk: Any, simulation: Any) -> None:
    port = open_port("bulk")
    reading = GroupBulkRead(port, sdk)
    assert reading.addParam(1, PRESENT, 2)
    assert reading.addParam(3, PRESENT, 2)
    reading.makeParam()
    simulation.expect_refusals("bulk", 1)
    assert sdk.bulkReadTx(port, reading.param, len(reading.param)) == COMM_SUCCESS
    assert sdk.readRx(port, 1, 2)[1] == COMM_SUCCESS
    port.patience_ms = 30.0
    port.setPacketTimeout(8)
    assert sdk.readRx(port, 3, 2)[1] == COMM_RX_TIMEOUT


def test_what_the_manual_forbids_gets_its_error_bits(open_port: Any, sdk: Any, simulation: Any) -> None:
    port = open_port("refused")
    assert good(sdk.write2ByteTxRx(port, 2, CW_LIMIT, 100))
    refused = {
        "angle limit": sdk.write2ByteTxRx(port, 2, GOAL, 50),
        "out of range": sdk.write1ByteTxRx(port, 1, LED, 2),
        "read only": sdk.write2ByteTxRx(port, 1, PRESENT, 0),
    }
    simulation.expect_refusals("refused", 3)
    words = {name: sdk.getRxPacketError(error) for name, (_, error) in refused.items()}
    assert all(result == COMM_SUCCESS for result, _ in refused.values())
    assert "Angle limit" in words["angle limit"]
    assert "Out of range" in words["out of range"]
    assert "Out of range" in words["read only"]
    assert sdk.ping(port, 1) == (AX12, COMM_SUCCESS, 0)  # an error is told once, with its instruction


def test_an_action_without_a_registered_write_is_an_instruction_error(
    open_port: Any, sdk: Any, simulation: Any
) -> None:
    port = open_port("refused")
    simulation.expect_refusals("refused", 1)
    _, result, error = sdk.txRxPacket(port, [0, 0, 1, 2, 5, 0])
    assert result == COMM_SUCCESS
    assert "Instruction code" in sdk.getRxPacketError(error)


def test_lock_closes_the_eeprom_until_the_power_is_cut(open_port: Any, sdk: Any, simulation: Any) -> None:
    port = open_port("renamed")
    assert good(sdk.write1ByteTxRx(port, 2, LOCK, 1))
    simulation.expect_refusals("renamed", 2)
    assert sdk.write1ByteTxRx(port, 2, RETURN_DELAY, 100)[1] != 0
    assert sdk.write1ByteTxRx(port, 2, LOCK, 0)[1] != 0
    assert good(sdk.write1ByteTxRx(port, 2, LED, 1))


def test_registered_writes_happen_at_the_action_of_all(open_port: Any, sdk: Any) -> None:
    port = open_port("registered")
    assert good(*(sdk.regWriteTxRx(port, each, LED, 1, [1]) for each in (1, 2)))
    assert [sdk.read1ByteTxRx(port, each, LED)[0] for each in (1, 2)] == [0, 0]
    assert [sdk.read1ByteTxRx(port, each, REGISTERED)[0] for each in (1, 2)] == [1, 1]
    assert sdk.action(port, BROADCAST) == COMM_SUCCESS
    assert [sdk.read1ByteTxRx(port, each, LED)[0] for each in (1, 2)] == [1, 1]
    assert [sdk.read1ByteTxRx(port, each, REGISTERED)[0] for each in (1, 2)] == [0, 0]


def test_both_angle_limits_at_zero_make_a_wheel(open_port: Any, sdk: Any) -> None:
    port = open_port("wheel")
    assert good(sdk.write2ByteTxRx(port, 1, CW_LIMIT, 0), sdk.write2ByteTxRx(port, 1, CCW_LIMIT, 0))
    assert good(sdk.write1ByteTxRx(port, 1, TORQUE, 1))
    for clockwise in (0, 1 << 10):
        assert good(sdk.write2ByteTxRx(port, 1, SPEED, 300 | clockwise))
        turning = range(clockwise + 150, clockwise + 450)
        assert until(lambda turning=turning: sdk.read2ByteTxRx(port, 1, PRESENT_SPEED)[0] in turning)
    assert good(sdk.write2ByteTxRx(port, 1, SPEED, 0), sdk.write1ByteTxRx(port, 1, TORQUE, 0))


def test_a_new_id_answers_where_the_old_one_is_silent(open_port: Any, sdk: Any) -> None:
    port = open_port("renamed")
    assert good(sdk.write1ByteTxRx(port, 1, ID, 200))
    assert sdk.ping(port, 200) == (AX12, COMM_SUCCESS, 0)
    port.patience_ms = 30.0
    assert sdk.ping(port, 1)[1] == COMM_RX_TIMEOUT
    port.patience_ms = DEADLINE_S * 1000
    assert good(sdk.write1ByteTxRx(port, 200, ID, 1))


def test_factory_reset_answers_as_before_and_is_the_maker_s_servo_after(open_port: Any, sdk: Any) -> None:
    port = open_port("reset")
    assert good(sdk.write1ByteTxRx(port, 7, RETURN_DELAY, 0))
    assert good(sdk.factoryReset(port, 7))
    assert until(lambda: sdk.ping(port, 1)[0] == AX12)  # e-Manual, AX-12A: ID 1, 1 Mbit/s
    assert sdk.read1ByteTxRx(port, 1, RETURN_DELAY) == (250, COMM_SUCCESS, 0)
    assert good(sdk.factoryReset(port, 8))
    assert port.setBaudRate(57_600)
    assert until(lambda: sdk.ping(port, 1)[0] == MX28)  # e-Manual, MX-28: ID 1, 57,600 bit/s
    assert sdk.read1ByteTxRx(port, 1, BAUD_RATE) == (34, COMM_SUCCESS, 0)
