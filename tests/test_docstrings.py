"""The examples in docstrings of what authors of plug-ins and of programs use run as they stand."""

import inspect
import math
import pkgutil
import textwrap
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import dxlrun
import dxlrun.tooling
from dxlrun import Controller, Interfaces, ParametersModel, RemoteRobot, Sensor
from dxlrun.control.controllers.plugin_loading import controller_breach
from dxlrun.features.sensors.offer import sensor_breach
from dxlrun.testing import simulated_robot


def example(thing: object, indent: int = 8, **names: Any) -> dict[str, Any]:
    """Run the part of a docstring that is indented so far and return its names."""
    lines = str(thing.__doc__).splitlines()
    source = textwrap.dedent("\n".join(line for line in lines if line.startswith(" " * indent) or not line))
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


def test_the_examples_of_the_tooling_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "robots").symlink_to(Path(__file__).parents[1] / "robots")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(dxlrun, "connect", lambda: SimpleNamespace(info=lambda: None))
    simulated_robot("robots/bioloid_torso.yaml", duration_s=0.1, log=tmp_path / "run.mcap").run()
    names = [page.name for page in pkgutil.iter_modules(dxlrun.tooling.__path__)]
    pages = [dxlrun.tooling, *(import_module(f"dxlrun.tooling.{name}") for name in sorted(names))]
    made = [set(example(page, indent=4)) - {"__builtins__", "annotations"} for page in pages]
    assert all(made), made


@pytest.mark.needs("logs")
def test_no_name_is_on_two_pages_of_the_faces() -> None:
    """Each name has one home, and each page imports what it offers."""
    names = list(dxlrun.__all__)
    for page in pkgutil.iter_modules(dxlrun.tooling.__path__):
        face = import_module(f"dxlrun.tooling.{page.name}")
        assert {getattr(face, name, None) for name in face.__all__} - {None}, page.name
        names += face.__all__
    assert sorted({name for name in names if names.count(name) > 1}) == []
