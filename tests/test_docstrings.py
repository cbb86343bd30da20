"""The examples in docstrings of what authors of plug-ins and of programs use run as they stand."""

from __future__ import annotations

import inspect
import math
import textwrap
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import dxlrun
from dxlrun import Controller, Interfaces, ParametersModel, RemoteRobot, Sensor
from dxlrun.control.controllers.plugins import controller_breach
from dxlrun.control.sensors.offer import sensor_breach
from dxlrun.testing import simulated_robot


def example(thing: object, **names: Any) -> dict[str, Any]:
    """Run the indented part of a docstring and return its names."""
    lines = str(thing.__doc__).splitlines()
    source = textwrap.dedent("\n".join(line for line in lines if line.startswith(" " * 8) or not line))
    exec(source, names)  # noqa: S102  of this repository
    return names


def test_the_controller_fits_its_contract() -> None:
    face = {name: getattr(dxlrun, name) for name in ("Controller", "Interfaces", "ParametersModel")}
    wave = example(Controller, math=math, np=np, **face)["Wave"]
    assert controller_breach(wave) is None
    assert wave.interfaces(None, ("pan",)) == Interfaces(("pan",), ("position",))


def test_the_sensor_fits_its_contract() -> None:
    made = example(Sensor, Sensor=Sensor, ParametersModel=ParametersModel)
    assert sensor_breach(made["Thermometer"]) is None


def test_the_robot_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(Path(__file__).parents[1])
    robot = example(simulated_robot, simulated_robot=simulated_robot)["robot"]
    assert robot.cycles == 25


def test_the_client_asks_and_sends(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    class Answering:
        def __enter__(self) -> RemoteRobot:
            return self  # type: ignore[return-value]  # what the example calls

        def __exit__(self, *_: object) -> None: ...

        def states(self) -> SimpleNamespace:
            return SimpleNamespace(joints=("pan",), position=[0.1])

        def send(self, *words: object) -> None:
            asked.append(inspect.signature(RemoteRobot.send).bind(self, *words))

    monkeypatch.setattr(dxlrun, "connect", Answering)
    example(RemoteRobot, dxlrun=dxlrun)
    assert asked[0].arguments["kind"] == "posvel"
