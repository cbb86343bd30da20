from functools import cache
from pathlib import Path

import pytest

from dxlrun import Controller, Interfaces, ParametersModel
from dxlrun.compile import robot_compiler
from dxlrun.control.controllers.plugin_loading import Offer, PlugIns, load_plugins


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let each test write its files into a folder of its own."""
    monkeypatch.chdir(tmp_path)


class PartParameters(ParametersModel):
    joints: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    exports: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    motors: tuple[str, ...] = ()
    takeovers: tuple[str, ...] = ()
    orientation: str = ""


class Part(Controller[PartParameters]):
    """A controller of any place in the graph, which is compiled and not run."""

    Parameters = PartParameters

    @classmethod
    def interfaces(cls, parameters, joints):
        own = parameters
        return Interfaces(
            own.joints, own.command, own.exports, own.reads, own.motors, takeovers=own.takeovers
        )


@pytest.fixture
def part_plugins(monkeypatch: pytest.MonkeyPatch) -> None:
    """Offer the type `part` to the compiler."""
    monkeypatch.setattr(
        robot_compiler,
        "load_plugins",
        lambda **more: load_plugins(**more) if more.get("files") else _with_part(),
    )


@cache
def _with_part() -> PlugIns:
    offers = {**load_plugins().controllers, "part": Offer("part", Part, "elsewhere 2.1")}
    return PlugIns(offers, {}, drivers=load_plugins().drivers)
