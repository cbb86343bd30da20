"""Hosts that others wrote talk to our servos of Protocol 2.0, over a pseudo-terminal.

The maker's SDK is asked only where it is right: well-formed packets, no stuffing, no silent servos.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import rustypot
from dynamixel_sdk import (
    COMM_SUCCESS,
    GroupBulkRead,
    GroupSyncRead,
    GroupSyncWrite,
    PortHandler,
    port_handler,
    protocol2_packet_handler,
)

from dxlrun.control_table import control_table
from dxlrun.simulation import BusConfig, ServoConfig

RATE = 1_000_000
PATIENCE_MS = 20_000
"""How long the SDK waits for what must come; it decides nothing but when to give up."""

ARM = BusConfig("arm", RATE, tuple(ServoConfig(each, "XM430-W350", 2.0) for each in (11, 12)), 2.0)
HEAD = BusConfig("head", RATE, tuple(ServoConfig(each, "XL430-W250", 2.0) for each in (1, 2)), 2.0)


@pytest.fixture
def running(start_buses: Callable[..., Any]) -> Any:
    return start_buses((ARM, HEAD))


@pytest.fixture
def port(running: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.setattr(port_handler, "LATENCY_TIMER", PATIENCE_MS / 2)
    handler = PortHandler(running.ports["arm"])
    assert handler.setBaudRate(RATE)
    yield handler
    handler.closePort()


@pytest.fixture
def sdk() -> Any:
    return protocol2_packet_handler.Protocol2PacketHandler()


def nothing_was_refused(running: Any) -> bool:
    return not [entry.note for entry in running.ledger() if entry.note]


def test_the_sdk_pings_reads_and_writes(running: Any, port: Any, sdk: Any) -> None:
    assert sdk.ping(port, 11) == (1020, COMM_SUCCESS, 0)
    assert sdk.read4ByteTxRx(port, 12, 132) == (round(2.0 / control_table("XM430-W350").rad_per_tick), 0, 0)
    assert sdk.write1ByteTxRx(port, 11, 64, 1) == (COMM_SUCCESS, 0)
    assert sdk.write4ByteTxRx(port, 11, 112, 77) == (COMM_SUCCESS, 0)
    assert sdk.read1ByteTxRx(port, 11, 64) == (1, COMM_SUCCESS, 0)
    assert sdk.read4ByteTxRx(port, 11, 112) == (77, COMM_SUCCESS, 0)
    assert sdk.write1ByteTxRx(port, 11, 64, 0) == (COMM_SUCCESS, 0)
    assert sdk.clearMultiTurn(port, 11) == (COMM_SUCCESS, 0)
    assert all(sdk.regWriteTxRx(port, each, 65, 1, [1]) == (COMM_SUCCESS, 0) for each in (11, 12))
    assert sdk.action(port, 0xFE) == COMM_SUCCESS  # it never waits for an answer to this one
    assert sdk.read1ByteTxRx(port, 11, 65) == (1, COMM_SUCCESS, 0)
    running.hang_up()
    assert nothing_was_refused(running)


def test_the_sdk_is_told_the_manual_s_errors(port: Any, sdk: Any) -> None:
    assert sdk.write1ByteTxRx(port, 11, 64, 2) == (COMM_SUCCESS, 4)
    assert sdk.write1ByteTxRx(port, 11, 132, 0) == (COMM_SUCCESS, 7)
    assert sdk.write2ByteTxRx(port, 11, 116, 0) == (COMM_SUCCESS, 5)


def test_the_sdk_reads_and_writes_many_at_once(running: Any, port: Any, sdk: Any) -> None:
    writing = GroupSyncWrite(port, sdk, 112, 4)
    for servo_id, value in ((11, 100), (12, 200)):
        assert writing.addParam(servo_id, value.to_bytes(4, "little"))
    assert writing.txPacket() == COMM_SUCCESS
    reading = GroupSyncRead(port, sdk, 112, 4)
    assert all(reading.addParam(each) for each in (11, 12))
    assert reading.txRxPacket() == COMM_SUCCESS
    assert [reading.getData(each, 112, 4) for each in (11, 12)] == [100, 200]
    bulk = GroupBulkRead(port, sdk)
    assert bulk.addParam(11, 112, 4)
    assert bulk.addParam(12, 0, 2)
    assert bulk.txRxPacket() == COMM_SUCCESS
    assert [bulk.getData(11, 112, 4), bulk.getData(12, 0, 2)] == [100, 1020]
    assert reading.fastSyncRead() == COMM_SUCCESS
    assert [reading.getData(each, 112, 4) for each in (11, 12)] == [100, 200]
    running.hang_up()
    assert nothing_was_refused(running)


def test_rustypot_finds_every_item_where_the_servo_holds_it(running: Any) -> None:
    table = control_table("XL430-W250")
    foreign = rustypot.Xl430PyController(running.ports["head"], RATE, PATIENCE_MS / 1000)
    names = [each for each in dir(foreign) if each.startswith("read_")]
    compared = 0
    for item in table.items.values():
        if f"read_{item.name}" in names and item.name not in ("realtime_tick",):
            ours = bytes(foreign.read_raw_data(1, item.address, item.size))
            assert foreign.read_register(1, item.name) == item.decode(ours), item.name
            compared += 1
    assert compared > 40
    assert foreign.ping(1)
    foreign.write_torque_enable(1, True)
    foreign.sync_write_register([1, 2], "goal_position", [1500, 2500])
    assert foreign.sync_read_register([1, 2], "goal_position") == [1500, 2500]
    foreign.close()
    running.hang_up()
    assert nothing_was_refused(running)
