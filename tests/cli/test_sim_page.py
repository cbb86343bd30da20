"""simulation.md says what is so."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from tests.kit.pages import page_text

from dxlrun.cli.sim import sim
from dxlrun.run.simulation_front import SimulationResult
from dxlsim.faults.kinds import KINDS
from dxlsim.messages import SimulationJob, SimulationMessage
from dxlsim.simulation_plan import SimulationConfig

ROOT = Path(__file__).parents[2]
PAGE = page_text("simulation.md")
COMMANDS = re.findall(r"^    (dxlrun sim .+)$", PAGE, re.MULTILINE)


@pytest.mark.parametrize("line", COMMANDS)
def test_each_command_of_the_page_is_understood(dxlrun, line, monkeypatch, tmp_path):
    asked: list[SimulationConfig] = []

    def serve(job: SimulationJob, *_: object, **__: object) -> SimulationResult:
        asked.append(job.config)
        return SimulationResult(1.0, SimulationMessage(), ())

    monkeypatch.setattr(sim, "_serve", serve)
    (tmp_path / "robots").symlink_to(ROOT / "robots")
    monkeypatch.chdir(tmp_path)

    if " LOG" in line:
        assert dxlrun("robots/single_joint.yaml", "--virtual", "--duration", 0.1).code == 0
        (log,) = tmp_path.glob("logs/*.mcap")
        line = line.replace(" LOG", f" {log}")

    said = dxlrun(*shlex.split(line)[1:])

    assert said.code == 0, said.err
    ((bus,),) = (config.buses for config in asked)
    assert bool(bus.servos) != bool(bus.recorded)


def test_the_page_lists_every_kind_of_fault():
    rows = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \| .* \|$", PAGE.split("## Faults")[1], re.MULTILINE)
    assert {kind for row in rows for kind in re.findall(r"`(\w+)`", row)} == set(KINDS)
