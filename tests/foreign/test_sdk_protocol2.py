"""The examples of the maker's SDK for Protocol 2.0, each as a test; what they print is asserted here.

The SDK is asked only where it is right: it stuffs nothing that it sends, and loses a sync read in which one
servo is silent.
"""

from typing import Any

from dynamixel_sdk import COMM_SUCCESS, GroupBulkRead, GroupBulkWrite, GroupSyncRead, GroupSyncWrite
from tests.foreign.conftest import Item
from tests.kit.awaited import until

from dxlsim.simulation_plan import BusConfig, ServoConfig

PROTOCOL = 2.0
XL430, XM430 = 1060, 1020
"""Model numbers (e-Manual, control tables, Model Number (0))."""
FIRMWARE, OPERATING_MODE, TORQUE, LED, MOVING = (Item(address, 1) for address in (6, 11, 64, 65, 122))
GOAL_VELOCITY, PROFILE_VELOCITY, GOAL, PRESENT = (Item(address, 4) for address in (104, 112, 116, 132))
INDIRECT_ADDRESS, INDIRECT_DATA = 168, 224


def two(model: str, name: str) -> BusConfig:
    return BusConfig(name, 1_000_000, tuple(ServoConfig(each, model, 3.0) for each in (1, 2)), 2.0)


BUSES = (
    *(two("XL430-W250", name) for name in ("ping", "sync")),
    *(two("XM430-W350", name) for name in ("read_write", "bulk", "indirect")),
    BusConfig("crowd", 1_000_000, tuple(ServoConfig(n, "XL430-W250", 1.0) for n in (0, 7, 40, 252)), 2.0),
)


def test_ping_on_two_ports_which_are_two_lines(connect: Any) -> None:
    host, other = connect("ping"), connect("indirect")
    assert [host.ping(each) for each in (1, 2)] == [XL430] * 2
    assert other.ping(1) == XM430
    assert host.is_silent(3)


def test_broadcast_ping_finds_all_servos_and_their_firmware(connect: Any) -> None:
    host = connect("crowd")
    firmware = {each: host.read(each, FIRMWARE) for each in (0, 7, 40, 252)}
    host.port.wanted = 4 * 14
    found, result = host.sdk.broadcastPing(host.port)
    assert result == COMM_SUCCESS
    assert found == {each: [XL430, version] for each, version in firmware.items()}


def test_read_write_moves_the_servo_to_its_goal(connect: Any) -> None:
    host = connect("read_write")
    start = host.read(1, PRESENT)
    assert start == round(3.0 / 6.283185 * 4096)
    host.write(1, TORQUE, 1)
    for goal in (start + 250, start):
        host.write(1, GOAL, goal)
        assert host.near(1, PRESENT, goal)
    host.write(1, TORQUE, 0)
    assert host.read(1, TORQUE) == 0


def test_writes_that_the_manual_forbids_get_its_errors(connect: Any) -> None:
    host = connect("read_write")
    assert "not available to target address" in host.refused(2, Item(132, 1), 0)  # read-only
    assert "out of range" in host.refused(2, TORQUE, 2)
    assert "length does not match" in host.refused(2, Item(116, 2), 0)
    limit = host.refused(2, GOAL_VELOCITY, 0x7FFF)  # beyond Velocity Limit
    assert "limit" in limit or "out of range" in limit
    host.write(2, TORQUE, 1)
    assert "not available to target address" in host.refused(2, OPERATING_MODE, 1)  # locked


def test_sync_read_and_sync_write_move_two_servos(connect: Any) -> None:
    host, goals = connect("sync"), {1: 2000, 2: 1900}
    for each in goals:
        host.write(each, TORQUE, 1)
    writing = GroupSyncWrite(host.port, host.sdk, *GOAL)
    assert all(writing.addParam(each, goal.to_bytes(4, "little")) for each, goal in goals.items())
    assert writing.txPacket() == COMM_SUCCESS
    reading = GroupSyncRead(host.port, host.sdk, *PRESENT)
    assert all(reading.addParam(each) for each in goals)

    def arrived() -> bool:
        assert reading.txRxPacket() == COMM_SUCCESS
        assert all(reading.isAvailable(each, *PRESENT) for each in goals)
        return all(abs(reading.getData(each, *PRESENT) - goal) <= 20 for each, goal in goals.items())

    assert until(arrived)


def test_bulk_read_and_bulk_write_of_different_items(connect: Any) -> None:
    host = connect("bulk")
    writing = GroupBulkWrite(host.port, host.sdk)
    assert writing.addParam(1, *PROFILE_VELOCITY, [77, 0, 0, 0])
    assert writing.addParam(2, *LED, [1])
    assert writing.txPacket() == COMM_SUCCESS
    reading = GroupBulkRead(host.port, host.sdk)
    assert reading.addParam(1, *PROFILE_VELOCITY)
    assert reading.addParam(2, *LED)
    for ask in (reading.txRxPacket, reading.fastBulkRead):
        assert ask() == COMM_SUCCESS
        assert [reading.getData(1, *PROFILE_VELOCITY), reading.getData(2, *LED)] == [77, 1]


def test_indirect_addresses_gather_items_in_one_block(connect: Any) -> None:
    host = connect("indirect")
    behind = [LED.address, *range(116, 120), *range(132, 136), MOVING.address]
    for number, address in enumerate(behind):
        host.write(1, Item(INDIRECT_ADDRESS + 2 * number, 2), address)
    assert host.read(1, Item(INDIRECT_ADDRESS, 2)) == LED.address
    host.write(1, TORQUE, 1)
    goal = host.read(1, PRESENT) + 100
    writing = GroupSyncWrite(host.port, host.sdk, INDIRECT_DATA, 5)
    assert writing.addParam(1, bytes((1,)) + goal.to_bytes(4, "little"))
    assert writing.txPacket() == COMM_SUCCESS
    assert (host.read(1, LED), host.read(1, GOAL)) == (1, goal)
    reading = GroupSyncRead(host.port, host.sdk, INDIRECT_DATA + 5, 5)
    assert reading.addParam(1)

    def arrived() -> bool:
        assert reading.txRxPacket() == COMM_SUCCESS
        return abs(reading.getData(1, INDIRECT_DATA + 5, 4) - goal) <= 20

    assert until(arrived)
