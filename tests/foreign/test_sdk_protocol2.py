"""The examples of the maker's SDK for Protocol 2.0, each as a test; what they print is asserted here.

The SDK is asked only where it is right: it stuffs nothing that it sends, and loses a sync read in which one
servo is silent.
"""

from __future__ import annotations

from typing import Any

import pytest
from dynamixel_sdk import (
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    GroupBulkRead,
    GroupBulkWrite,
    GroupSyncRead,
    GroupSyncWrite,
    Protocol2PacketHandler,
)
from tests.kit.awaited import until

from dxlsim.simulation_plan import BusConfig, ServoConfig

XL430, XM430 = 1060, 1020
"""Model numbers (e-Manual, control tables, Model Number (0))."""
ID, BAUD_RATE, OPERATING_MODE, TORQUE, LED, GOAL, PRESENT = 7, 8, 11, 64, 65, 116, 132
"""Addresses of the X series."""
RETURN_DELAY, PROFILE_VELOCITY, MOVING, INDIRECT_ADDRESS, INDIRECT_DATA = 9, 112, 122, 168, 224
NEAR = 20
"""Ticks that the examples call arrived."""
BROADCAST = 0xFE


def two(model: str, name: str) -> BusConfig:
    return BusConfig(name, 1_000_000, tuple(ServoConfig(each, model, 3.0) for each in (1, 2)), 2.0)


BUSES = (
    two("XL430-W250", "ping"),
    two("XM430-W350", "read_write"),
    two("XL430-W250", "sync"),
    two("XM430-W350", "bulk"),
    two("XM430-W350", "indirect"),
    two("XL430-W250", "reset"),
    two("XM430-W350", "reboot"),
    BusConfig("turns", 1_000_000, (ServoConfig(1, "XM430-W350", 6.2),), 2.0),
    BusConfig("turning", 1_000_000, (ServoConfig(1, "XM430-W350", 1.0),), 2.0),
    two("XL430-W250", "registered"),
    BusConfig("crowd", 1_000_000, tuple(ServoConfig(n, "XL430-W250", 1.0) for n in (0, 7, 40, 252)), 2.0),
)


@pytest.fixture
def sdk() -> Any:
    return Protocol2PacketHandler()


def good(*results: tuple[int, int]) -> bool:
    return all(each == (COMM_SUCCESS, 0) for each in results)


def answers_again(sdk: Any, port: Any, servo_id: int) -> bool:
    """Return whether a servo that starts anew answers within the patience."""
    patience, port.patience_ms = port.patience_ms, 30.0
    try:
        return until(lambda: sdk.ping(port, servo_id)[1] == COMM_SUCCESS)
    finally:
        port.patience_ms = patience


def test_ping(open_port: Any, sdk: Any) -> None:
    port = open_port("ping")
    assert [sdk.ping(port, each) for each in (1, 2)] == [(XL430, COMM_SUCCESS, 0)] * 2
    port.patience_ms = 30.0
    assert sdk.ping(port, 3) == (0, COMM_RX_TIMEOUT, 0)


def test_broadcast_ping_finds_all_servos_and_their_firmware(open_port: Any, sdk: Any) -> None:
    port = open_port("crowd")
    firmware = {each: sdk.read1ByteTxRx(port, each, 6)[0] for each in (0, 7, 40, 252)}
    port.wanted = 4 * 14
    found, result = sdk.broadcastPing(port)
    assert result == COMM_SUCCESS
    assert found == {each: [XL430, version] for each, version in firmware.items()}


def test_read_write_moves_the_servo_to_its_goal(open_port: Any, sdk: Any) -> None:
    port = open_port("read_write")
    start, result, error = sdk.read4ByteTxRx(port, 1, PRESENT)
    assert (start, result, error) == (round(3.0 / 6.283185 * 4096), COMM_SUCCESS, 0)
    assert good(sdk.write1ByteTxRx(port, 1, TORQUE, 1))
    for goal in (start + 250, start):
        assert good(sdk.write4ByteTxRx(port, 1, GOAL, goal))
        assert until(lambda goal=goal: abs(sdk.read4ByteTxRx(port, 1, PRESENT)[0] - goal) <= NEAR)
    assert good(sdk.write1ByteTxRx(port, 1, TORQUE, 0))
    assert sdk.read1ByteTxRx(port, 1, TORQUE) == (0, COMM_SUCCESS, 0)


def test_writes_that_the_manual_forbids_get_its_errors(open_port: Any, sdk: Any, simulation: Any) -> None:
    port = open_port("read_write")
    refused = {
        "access": sdk.write1ByteTxRx(port, 2, 132, 0),  # read-only
        "range": sdk.write1ByteTxRx(port, 2, TORQUE, 2),
        "length": sdk.write2ByteTxRx(port, 2, GOAL, 0),
        "limit": sdk.write4ByteTxRx(port, 2, 104, 0x7FFF),  # Goal Velocity beyond Velocity Limit
    }
    assert good(sdk.write1ByteTxRx(port, 2, TORQUE, 1))
    refused["locked"] = sdk.write1ByteTxRx(port, 2, OPERATING_MODE, 1)
    simulation.expect_refusals("read_write", len(refused))
    words = {name: sdk.getRxPacketError(error) for name, (_, error) in refused.items()}
    assert all(result == COMM_SUCCESS for result, _ in refused.values())
    assert "not available to target address" in words["access"]
    assert "out of range" in words["range"]
    assert "length does not match" in words["length"]
    assert "limit" in words["limit"] or "out of range" in words["limit"]
    assert "not available to target address" in words["locked"]


def test_sync_read_and_sync_write_move_two_servos(open_port: Any, sdk: Any) -> None:
    port = open_port("sync")
    assert good(*(sdk.write1ByteTxRx(port, each, TORQUE, 1) for each in (1, 2)))
    goals = {1: 2000, 2: 1900}
    writing = GroupSyncWrite(port, sdk, GOAL, 4)
    assert all(writing.addParam(each, goal.to_bytes(4, "little")) for each, goal in goals.items())
    assert writing.txPacket() == COMM_SUCCESS
    reading = GroupSyncRead(port, sdk, PRESENT, 4)
    assert all(reading.addParam(each) for each in goals)

    def arrived() -> bool:
        assert reading.txRxPacket() == COMM_SUCCESS
        assert all(reading.isAvailable(each, PRESENT, 4) for each in goals)
        return all(abs(reading.getData(each, PRESENT, 4) - goal) <= NEAR for each, goal in goals.items())

    assert until(arrived)


def test_fast_sync_read_tells_the_same_as_sync_read(open_port: Any, sdk: Any) -> None:
    port = open_port("sync")
    reading = GroupSyncRead(port, sdk, 36, 4)  # PWM Limit, Velocity Limit... constant of the EEPROM
    assert all(reading.addParam(each) for each in (1, 2))
    assert reading.txRxPacket() == COMM_SUCCESS
    slow = [reading.getData(each, 36, 4) for each in (1, 2)]
    assert reading.fastSyncRead() == COMM_SUCCESS
    assert [reading.getData(each, 36, 4) for each in (1, 2)] == slow
    assert slow[0] & 0xFFFF == 885  # e-Manual, PWM Limit (36)


def test_bulk_read_and_bulk_write_of_different_items(open_port: Any, sdk: Any) -> None:
    port = open_port("bulk")
    writing = GroupBulkWrite(port, sdk)
    assert writing.addParam(1, PROFILE_VELOCITY, 4, [77, 0, 0, 0])
    assert writing.addParam(2, LED, 1, [1])
    assert writing.txPacket() == COMM_SUCCESS
    reading = GroupBulkRead(port, sdk)
    assert reading.addParam(1, PROFILE_VELOCITY, 4)
    assert reading.addParam(2, LED, 1)
    for ask in (reading.txRxPacket, reading.fastBulkRead):
        assert ask() == COMM_SUCCESS
        assert reading.getData(1, PROFILE_VELOCITY, 4) == 77
        assert reading.getData(2, LED, 1) == 1


def test_indirect_addresses_gather_items_in_one_block(open_port: Any, sdk: Any) -> None:
    port = open_port("indirect")
    behind = [LED, *range(GOAL, GOAL + 4), *range(PRESENT, PRESENT + 4), MOVING]
    for number, address in enumerate(behind):
        assert good(sdk.write2ByteTxRx(port, 1, INDIRECT_ADDRESS + 2 * number, address))
    assert sdk.read2ByteTxRx(port, 1, INDIRECT_ADDRESS) == (LED, COMM_SUCCESS, 0)
    assert good(sdk.write1ByteTxRx(port, 1, TORQUE, 1))
    goal = sdk.read4ByteTxRx(port, 1, PRESENT)[0] + 100
    writing = GroupSyncWrite(port, sdk, INDIRECT_DATA, 5)
    assert writing.addParam(1, bytes((1,)) + goal.to_bytes(4, "little"))
    assert writing.txPacket() == COMM_SUCCESS
    assert sdk.read1ByteTxRx(port, 1, LED) == (1, COMM_SUCCESS, 0)
    assert sdk.read4ByteTxRx(port, 1, GOAL) == (goal, COMM_SUCCESS, 0)
    reading = GroupSyncRead(port, sdk, INDIRECT_DATA + 5, 5)
    assert reading.addParam(1)

    def arrived() -> bool:
        assert reading.txRxPacket() == COMM_SUCCESS
        return abs(reading.getData(1, INDIRECT_DATA + 5, 4) - goal) <= NEAR

    assert until(arrived)


def test_indirect_addresses_are_those_of_the_manual_again_after_a_reboot(
    open_port: Any, sdk: Any, simulation: Any
) -> None:
    simulation.expect_haste("indirect")
    port = open_port("indirect")
    first = sdk.read2ByteTxRx(port, 2, INDIRECT_ADDRESS)
    assert first == (INDIRECT_DATA, COMM_SUCCESS, 0)  # e-Manual: each points at its own data
    assert good(sdk.write2ByteTxRx(port, 2, INDIRECT_ADDRESS, PRESENT))
    assert good(sdk.reboot(port, 2))
    assert answers_again(sdk, port, 2)
    assert sdk.read2ByteTxRx(port, 2, INDIRECT_ADDRESS) == first


def test_reboot_brings_the_ram_to_its_start_and_keeps_the_eeprom(
    open_port: Any, sdk: Any, simulation: Any
) -> None:
    simulation.expect_haste("reboot")
    port = open_port("reboot")
    assert good(sdk.write1ByteTxRx(port, 1, RETURN_DELAY, 100))
    assert good(sdk.write1ByteTxRx(port, 1, LED, 1), sdk.write1ByteTxRx(port, 1, TORQUE, 1))
    assert good(sdk.reboot(port, 1))
    assert answers_again(sdk, port, 1)
    assert [sdk.read1ByteTxRx(port, 1, each)[0] for each in (TORQUE, LED, RETURN_DELAY)] == [0, 0, 100]


def test_factory_reset_keeps_what_its_option_names(open_port: Any, sdk: Any, simulation: Any) -> None:
    simulation.expect_haste("reset")
    port = open_port("reset")
    assert good(sdk.write1ByteTxRx(port, 2, RETURN_DELAY, 0))
    assert good(sdk.factoryReset(port, 2, 0x02))  # all but ID and baud rate
    assert answers_again(sdk, port, 2)
    assert sdk.read1ByteTxRx(port, 2, RETURN_DELAY) == (250, COMM_SUCCESS, 0)
    assert sdk.read1ByteTxRx(port, 2, BAUD_RATE) == (3, COMM_SUCCESS, 0)
    assert good(sdk.factoryReset(port, 2, 0x01))  # all but the ID
    assert port.setBaudRate(57_600)
    assert answers_again(sdk, port, 2)
    assert sdk.read1ByteTxRx(port, 2, BAUD_RATE) == (1, COMM_SUCCESS, 0)
    assert good(sdk.factoryReset(port, 2, 0xFF))  # all: its ID is that of the other one, at another rate
    assert answers_again(sdk, port, 1)
    port.patience_ms = 30.0
    assert sdk.ping(port, 2)[1] == COMM_RX_TIMEOUT


def test_clear_multi_turn_brings_the_position_back_into_one_turn(open_port: Any, sdk: Any) -> None:
    port = open_port("turns")
    assert good(sdk.write1ByteTxRx(port, 1, OPERATING_MODE, 4), sdk.write1ByteTxRx(port, 1, TORQUE, 1))
    assert good(sdk.write4ByteTxRx(port, 1, GOAL, 4300))
    assert until(lambda: abs(sdk.read4ByteTxRx(port, 1, PRESENT)[0] - 4300) <= NEAR)
    assert until(lambda: sdk.read1ByteTxRx(port, 1, MOVING)[0] == 0)
    before = sdk.read4ByteTxRx(port, 1, PRESENT)[0]
    assert good(sdk.write1ByteTxRx(port, 1, TORQUE, 0))
    assert good(sdk.clearMultiTurn(port, 1))
    assert abs(sdk.read4ByteTxRx(port, 1, PRESENT)[0] - (before - 4096)) <= 2


def test_clear_multi_turn_fails_while_the_servo_moves(open_port: Any, sdk: Any, simulation: Any) -> None:
    port = open_port("turning")
    assert good(sdk.write1ByteTxRx(port, 1, TORQUE, 0), sdk.write1ByteTxRx(port, 1, OPERATING_MODE, 4))
    assert good(sdk.write4ByteTxRx(port, 1, PROFILE_VELOCITY, 30))
    assert good(sdk.write1ByteTxRx(port, 1, TORQUE, 1), sdk.write4ByteTxRx(port, 1, GOAL, 100_000))
    assert until(lambda: sdk.read1ByteTxRx(port, 1, MOVING)[0] == 1)
    simulation.expect_refusals("turning", 1)
    assert sdk.clearMultiTurn(port, 1) == (COMM_SUCCESS, 1)  # e-Manual, Clear: Result Fail
    assert good(sdk.write1ByteTxRx(port, 1, TORQUE, 0))


def test_registered_writes_happen_at_the_action_of_all(open_port: Any, sdk: Any) -> None:
    port = open_port("registered")
    assert good(*(sdk.regWriteTxRx(port, each, LED, 1, [1]) for each in (1, 2)))
    assert [sdk.read1ByteTxRx(port, each, LED)[0] for each in (1, 2)] == [0, 0]
    assert [sdk.read1ByteTxRx(port, each, 69)[0] for each in (1, 2)] == [1, 1]  # Registered Instruction
    assert sdk.action(port, BROADCAST) == COMM_SUCCESS
    assert [sdk.read1ByteTxRx(port, each, LED)[0] for each in (1, 2)] == [1, 1]
    assert [sdk.read1ByteTxRx(port, each, 69)[0] for each in (1, 2)] == [0, 0]


def test_a_new_id_answers_where_the_old_one_is_silent(open_port: Any, sdk: Any) -> None:
    port = open_port("registered")
    assert good(sdk.write1ByteTxRx(port, 2, ID, 200))
    assert sdk.ping(port, 200) == (XL430, COMM_SUCCESS, 0)
    assert good(sdk.write1ByteTxRx(port, 200, ID, 2))
    assert sdk.ping(port, 2) == (XL430, COMM_SUCCESS, 0)


def test_two_ports_are_two_lines(open_port: Any, sdk: Any) -> None:
    one, other = open_port("ping"), open_port("reboot")
    assert [sdk.ping(each, 1)[0] for each in (one, other)] == [XL430, XM430]
