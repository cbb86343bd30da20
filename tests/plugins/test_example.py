"""A stranger's package works beside dxlrun in an environment that has never seen this repository."""

import ast
import re
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "plugins" / "example"
README = (EXAMPLE / "README.md").read_text()
COMMANDS = [line.strip() for line in README.splitlines() if line.startswith("    dxlrun")]
SAYS = {
    "dxlrun check example.yaml": r"easing_position_controller +dxlrun-easing 0\.1\.0 ",
    "dxlrun example.yaml --virtual --duration 1": "0 of 50 periods skipped",
}
Shell = Callable[..., Any]
pytestmark = [pytest.mark.long, pytest.mark.timeout(400)]
"""The first of them builds and installs packages, with what they depend on from an index."""


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """The example's directory without its sources: what is imported there comes from the wheel."""
    assert set(SAYS) <= set(COMMANDS)
    return Path(shutil.copytree(EXAMPLE, tmp_path / "copy", ignore=shutil.ignore_patterns("src", "logs")))


def test_the_wheels_do_not_share_a_file(wheels: Path) -> None:
    ours, theirs = (
        set(zipfile.ZipFile(next(wheels.glob(name))).namelist()) for name in ("dxlrun-*", "dxlrun_e*")
    )
    assert not ours & theirs
    assert {"dxlrun_easing/easing.py", "dxlrun_easing/py.typed"} <= theirs
    assert any(name.endswith("licenses/LICENSE") for name in theirs)


@pytest.mark.parametrize("line", COMMANDS)
def test_the_readmes_commands_end_well(fresh: Shell, copy: Path, line: str) -> None:
    told = fresh(line, copy)
    assert (told.returncode, told.stderr) == (0, "")
    assert "easing_example: " in told.stdout
    assert re.search(SAYS.get(line, ""), told.stdout)


def test_every_parameter_of_the_readme_is_one_of_the_model() -> None:
    tree = ast.parse((EXAMPLE / "src/dxlrun_easing/easing.py").read_text())
    law = next(node for node in ast.walk(tree) if isinstance(node, ast.ClassDef) and node.name == "Easing")
    own = [node.target.id for node in law.body if isinstance(node, ast.AnnAssign)]
    fields = ["joints", *(name for name in own if name != "Commands")]
    assert re.findall(r"^\| `(\w+)`", README, re.MULTILINE) == fields


def test_it_imports_the_public_face_alone() -> None:
    imported = {
        node.module
        for path in EXAMPLE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("dxlrun")
    }
    assert imported <= {"dxlrun", "dxlrun.testing", "dxlrun_easing", "dxlrun_easing.easing"}
