"""Units of states: a device table or a sensor's class names them, and every output shows them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import pytest

from dxlrun import Sensor
from dxlrun.cli import main
from dxlrun.cli.steering.steer import sources
from dxlrun.features.sensors.compile import is_units
from dxlrun.log.log_reader import open_log
from dxlrun.output.quantity import names_with_units, quantity_text
from dxlrun.testing import simulated_robot
from dxlrun_analysis.report import analyze, tables

BOARD = """\
kind = "device"
model = "meadow"
protocol = 2.0
capabilities = ["sync_read"]
cyclic = ["light", "air", "open"]
units = ["lx"]

[items]
light = {address = 30, size = 2, tick = "0.5 lx", state = "illuminance"}
air = {address = 32, size = 2, tick = "0.1 degC", state = "temperature"}
open = {address = 34, size = 1, bit = 0, state = "door"}
fan = {address = 40, size = 2, access = "RW", tick = "1 rpm", maximum = 3000}
"""
ROBOT = """\
name: with_meadow
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}}
loop: {rate: 100}
joints: {neck: {bus: main, id: 1, model: XL430-W250, reference: 180 deg, direction: 1}}
devices:
  meadow:
    bus: main
    id: 7
    model: board.toml
    commands: [fan]
    simulation: {values: {illuminance: 120, temperature: 21.5}}
controllers:
  joint_state_broadcaster: {type: joint_state_broadcaster}
"""
UNITS = {"illuminance": "lx", "temperature": "degC"}


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    (tmp_path / "board.toml").write_text(BOARD)
    path = tmp_path / "robot.yaml"
    path.write_text(ROBOT)
    return path


def test_unit_of_a_device_table_is_in_list_log_and_report(robot, tmp_path):
    log = tmp_path / "run.mcap"
    run = simulated_robot(robot, duration_s=0.2, log=log)
    run.run()
    (source,) = run.plan.loop.sources
    assert (source.units, source.command_units) == (UNITS, {"fan": "rad/s"})
    (listed,) = sources({"sources": [msgspec.to_builtins(source)]}).rows
    assert [cell.text for cell in listed][2:] == [
        "fan=0..314.159 rad/s",
        "illuminance (lx); temperature (deg C); door",
    ]
    reader = open_log(log)
    assert reader.about.header.source_units == {f"meadow/{name}": unit for name, unit in UNITS.items()}
    report = analyze(reader)
    shown = [[cell.text for cell in row] for row in tables(report)["sources"].rows]
    assert shown[0][0] == "meadow/illuminance"
    assert shown[0][2:] == ["120 lx"] * 3
    assert [row[-1] for row in shown[1:]] == ["21.5 deg C", "0"]


def test_check_shows_units_of_a_device(robot, capsys):
    assert main(["check", str(robot), "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["result"]["devices"]
    assert row["states"] == ["illuminance", "temperature", "door"]
    assert (row["units"], row["command_units"]) == (UNITS, {"fan": "rad/s"})


def test_unknown_unit_of_a_table_is_refused(robot, capsys):
    (robot.parent / "board.toml").write_text(BOARD.replace('units = ["lx"]', ""))
    assert main(["check", str(robot)]) == 2
    assert "light: tick: '0.5 lx': the unit is not one of rad, deg" in " ".join(
        capsys.readouterr().err.split()
    )


def test_sensor_has_the_units_of_known_quantities_unless_it_names_its_own():
    class Gyroscope(Sensor[Any]):
        @classmethod
        def states(cls, parameters: Any) -> tuple[str, ...]:
            return ("angular_velocity.x", "illuminance", "temperature")

        def read(self, values: Any) -> int | None:
            return None

    assert Gyroscope.units(None) == {"angular_velocity.x": "rad/s", "temperature": "degC"}


@pytest.mark.parametrize(
    ("found", "fits"),
    [({"a": "lx"}, True), ({}, True), ({"c": "lx"}, False), ({"a": 1}, False), (("lx",), False)],
)
def test_units_of_a_sensor_are_texts_of_its_states(found, fits):
    assert is_units(found, ("a", "b")) is fits


def test_values_and_names_are_written_with_their_units():
    assert quantity_text(0.1234567, "rad/s") == "0.123457 rad/s"
    assert quantity_text(21.5, "degC", digits=2) == "22 deg C"
    assert (quantity_text(0.5, "1"), quantity_text(3.0), quantity_text(None, "V")) == ("0.5", "3", "-")
    assert names_with_units(("x", "y", "volts", "on"), {"x": "m", "y": "m", "volts": "V"}) == (
        "x, y (m); volts (V); on"
    )
