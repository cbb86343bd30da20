from functools import cache
from pathlib import Path

import numpy as np
import pytest

from dxlrun import Controller, Interfaces, ParametersModel
from dxlrun.compile import robot_compiler
from dxlrun.control.controllers.plugin_loading import Offer, PlugIns, load_plugins
from dxlrun.run import virtual_run


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let each test write its files into a folder of its own."""
    monkeypatch.chdir(tmp_path)


UNITS = {"position": 2 * np.pi / 4096, "velocity": 0.229 * 2 * np.pi / 60, "effort": 2.69e-3, "pwm": 1 / 885}
"""One step of a goal on the wire, of an XM430."""
READ: dict[str, list[np.ndarray]] = {}
"""What each part found in `reads`, update by update; the newest run's."""


class PartParameters(ParametersModel):
    joints: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    exports: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    motors: tuple[str, ...] = ()
    takeovers: tuple[str, ...] = ()
    steps: float = 0.0
    orientation: str = ""


class Part(Controller[PartParameters]):
    """A controller of any place in the graph: adds its own steps to what is commanded of it.

    A hundred-millionth more of them with each update shows which update a value is from.
    """

    Parameters = PartParameters

    @classmethod
    def interfaces(cls, parameters, joints):
        own = parameters
        return Interfaces(
            own.joints, own.command, own.exports, own.reads, own.motors, takeovers=own.takeovers
        )

    def on_activate(self, time_ns):
        self.updates = 0
        READ[self.context.name] = []

    def update(self, time_ns, period_ns):
        self.updates += 1
        READ[self.context.name].append(self.context.reads.copy())
        references, commands = self.context.references, self.context.commands
        for interface in self.parameters.command:
            above = getattr(references, interface)
            own = self.parameters.steps * (1 + self.updates * 1e-8) * UNITS[interface]
            getattr(commands, interface)[:] = own + np.where(np.isfinite(above), above, 0.0)


@pytest.fixture
def part_plugins(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[np.ndarray]]:
    """Offer the type `part`, to the compiler and to runs on virtual time; return what parts read."""
    for room in (robot_compiler, virtual_run):
        monkeypatch.setattr(
            room, "load_plugins", lambda **more: load_plugins(**more) if more.get("files") else _with_part()
        )
    return READ


@cache
def _with_part() -> PlugIns:
    offers = {**load_plugins().controllers, "part": Offer("part", Part, "elsewhere 2.1")}
    return PlugIns(offers, {}, drivers=load_plugins().drivers)
