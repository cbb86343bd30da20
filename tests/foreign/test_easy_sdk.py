"""The maker's newer Python interface (dynamixel_easy_sdk), which brings control tables of its own."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from dynamixel_easy_sdk import (
    Connector,
    ControlTable,
    Direction,
    DxlError,
    DxlRuntimeError,
    OperatingMode,
    ProfileConfiguration,
    connector,
)
from tests.foreign.conftest import PatientPort

from dxlsim.simulation_plan import BusConfig, ServoConfig
from dxlwire.control_table import all_tables, find_table

NUMBERS = ControlTable.parsingModelList()
MODELS = [
    table.model
    for table in all_tables()
    if table.protocol == 2.0 and table.model_number in NUMBERS and not table.model.endswith("-FW51")
]
"""Every model of which both know a table."""
POSITION = 1.0
"""rad, of every servo at the start: also a gripper reaches it."""
LINES = {
    "models": MODELS,
    "settings": ["XM430-W350"],
}
BUSES = [
    BusConfig(name, 1_000_000, tuple(ServoConfig(n, each, POSITION) for n, each in enumerate(models, 1)), 2.0)
    for name, models in LINES.items()
]


@pytest.fixture
def connect(simulation: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], Connector]]:
    """Connect to a bus, through a port that waits."""
    monkeypatch.setattr(connector, "PortHandler", PatientPort)
    opened: list[Connector] = []

    def open_bus(name: str) -> Connector:
        opened.append(Connector(simulation.ports[name], 1_000_000))
        return opened[-1]

    yield open_bus
    for each in opened:
        each.closePort()


def test_it_finds_every_model_and_reads_it_by_its_own_table(connect: Any) -> None:
    bus = connect("models")
    bus._port_handler.wanted = len(MODELS) * 14
    assert list(bus.broadcastPing()) == list(range(1, len(MODELS) + 1))
    for servo_id, model in enumerate(MODELS, start=1):
        if model == "XL-320":
            continue  # its file there has no operating mode, and a Motor reads it at once
        motor, table = bus.createMotor(servo_id), find_table(model, 2.0)
        assert (motor.model_number, motor.torque_status) == (table.model_number, 0)
        assert motor.operating_mode_status in (OperatingMode.POSITION, OperatingMode.CURRENT_BASED_POSITION)
        assert abs(motor.getPresentPosition() * table.rad_per_tick - POSITION) < 0.01, model


def test_settings_are_kept_and_limits_hold(connect: Any, simulation: Any) -> None:
    motor = connect("settings").createMotor(1)
    before = motor.getPresentPosition()
    motor.setDirection(Direction.REVERSE)
    motor.setProfileConfiguration(ProfileConfiguration.TIME_BASED)
    assert abs(motor.getPresentPosition() + before) <= 1  # e-Manual, Drive Mode (10): the sign turns
    motor.setDirection(Direction.NORMAL)
    motor.setHomingOffset(-300)
    assert abs(motor.getPresentPosition() - (before - 300)) <= 1
    motor.setHomingOffset(0)
    motor.setMinPositionLimit(500)
    motor.setMaxPositionLimit(900)
    assert (motor.getMinPositionLimit(), motor.getMaxPositionLimit()) == (500, 900)
    motor.enableTorque()
    simulation.expect_refusals("settings", 1)
    with pytest.raises(DxlRuntimeError, match="limit") as refused:
        motor.setGoalPosition(1000)
    assert refused.value.dxl_error == DxlError.SDK_ERRNUM_DATA_LIMIT
