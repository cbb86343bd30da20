"""controllers.md, typed as it stands: its commands and its excerpts."""

import re
from collections.abc import Callable
from pathlib import Path
from textwrap import dedent
from typing import Any

import numpy as np
import pytest
from tests.kit.pages import page_text

from dxlrun import CONTRACT_VERSION
from dxlrun.cli import main
from dxlrun.testing import read_log, simulated_robot

PAGE = page_text("controllers.md")
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
COMMANDS = [
    line.strip() for line in PAGE.splitlines() if line.startswith("    ") and not line.startswith("     ")
]
HEAD = """\
name: head
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {kind: ftdi}, return_delay_time: 0 us}
loop: {rate: 100}
joints:
  pan: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1}
controllers:
  wave: {type: ./wave.py:Wave, joints: [pan], amplitude: 20 deg}
"""
Shell = Callable[..., Any]
pytestmark = [pytest.mark.long, pytest.mark.timeout(400)]
"""Some build and install packages, with what they depend on from an index."""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A directory with the package that the page begins with."""
    assert main(["new-plugin", "my_robotics", str(tmp_path / "my_robotics")]) == 0
    return tmp_path / "my_robotics"


def test_its_excerpts_are_in_the_package_and_its_sketches_are_python(package: Path) -> None:
    texts = [path.read_text() for path in package.rglob("*.py")]
    excerpts = [block for block in BLOCKS if any(block in text for text in texts)]
    assert len(excerpts) == 1
    for sketch in BLOCKS:
        if sketch not in excerpts:
            compile(dedent(sketch), "controllers.md", "exec")


def test_its_commands_end_well_in_their_order(fresh: Shell, tmp_path: Path) -> None:
    lines = [line for line in COMMANDS if line.startswith(("pip", "dxlrun", "python", "cd"))]
    assert lines[:2] == ["dxlrun new-plugin my_robotics", "cd my_robotics"]
    assert len(lines) == 7
    place, said = tmp_path, ""
    for number, line in enumerate(lines):
        if line.startswith("cd "):
            place /= line.removeprefix("cd ")
            continue
        told = fresh(line, place, isolated=number == 2)
        assert told.returncode == 0, line + told.stdout + told.stderr
        said += told.stdout
    assert re.search(r"my_robotics_controller +my-robotics 0\.1\.0 ", said)
    assert [path.name for path in (place / "dist").iterdir()] == ["my_robotics-0.1.0-py3-none-any.whl"]
    source = place / "src/my_robotics/easing.py"
    assert source.read_text().count(" * share") == 1
    source.write_text(source.read_text().replace(" * share", ""))
    assert (
        fresh("python -m pytest -q && dxlrun example.yaml --virtual --play nod.yaml", place).returncode == 0
    )
    fresh("pip uninstall --yes my-robotics", place)


def test_contract_example_runs_from_a_file(tmp_path: Path) -> None:
    (class_,) = (block for block in BLOCKS if "class WaveParameters" in block)
    (tmp_path / "wave.py").write_text(class_)
    (tmp_path / "head.yaml").write_text(HEAD)
    robot = simulated_robot(tmp_path / "head.yaml", duration_s=7.0, log=tmp_path / "head.mcap")
    robot.run()
    position = read_log(tmp_path / "head.mcap").cycles["position"]
    assert np.ptp(np.degrees(position)) == pytest.approx(40, abs=2)


def test_the_contract_of_the_page_is_the_contract(package: Path) -> None:
    assert f"This one has contract {CONTRACT_VERSION}:" in PAGE
    assert f"return {CONTRACT_VERSION}\n" in (package / "src/my_robotics/plugin.py").read_text()
