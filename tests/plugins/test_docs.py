"""docs/controllers.md, typed as it stands: its files, its commands, its tests, and what it says of errors."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from textwrap import dedent
from typing import Any

import pytest

from dxlrun import CONTRACT_VERSION

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/controllers.md").read_text()
FILES = dict(re.findall(r"`([\w.]+\.(?:toml|py|yaml))`:\n\n```\w+\n(.*?)```", PAGE, re.DOTALL))
BLOCKS = re.findall(r"```\w+\n(.*?)```", PAGE, re.DOTALL)
COMMANDS = [
    line.strip() for line in PAGE.splitlines() if line.startswith("    ") and not line.startswith("     ")
]
Shell = Callable[..., Any]
pytestmark = pytest.mark.timeout(400)
"""Each builds and installs packages, with what they depend on from an index."""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """The directory of somebody who has copied the page's files."""
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    return tmp_path


def test_the_page_has_these_files_an_excerpt_and_sketches() -> None:
    assert list(FILES) == ["pyproject.toml", "my_robotics.py", "robot.yaml", "test_wave.py"]
    others = [block for block in BLOCKS if block not in FILES.values()]
    example = (ROOT / "plugins/example/src/dxlrun_easing/controller.py").read_text()
    (excerpt,) = (block for block in others if block in example)
    for sketch in others:
        if sketch != excerpt:
            compile(dedent(sketch), "controllers.md", "exec")


def test_its_commands_end_well_in_their_order(fresh: Shell, package: Path) -> None:
    lines = [line for line in COMMANDS if line.startswith(("pip", "dxlrun", "python"))]
    assert len(lines) == 6
    for number, line in enumerate(lines):
        told = fresh(line, package, isolated=number == 0)
        assert told.returncode == 0, line + told.stdout + told.stderr
    assert [path.name for path in (package / "dist").iterdir()] == ["my_robotics-0.1.0-py3-none-any.whl"]
    assert "arms" in fresh("dxlrun check robot.yaml", package).stdout
    fresh("pip uninstall --yes my-robotics", package)


def test_an_editable_install_finds_new_code_but_no_new_entry_point(fresh: Shell, package: Path) -> None:
    install = next(line for line in COMMANDS if line.startswith("pip install -e"))
    assert fresh(install, package).returncode == 0
    source, project = package / "my_robotics.py", package / "pyproject.toml"
    source.write_text(FILES["my_robotics.py"].replace('"wave"', '"swing"'))
    robot = package / "robot.yaml"
    robot.write_text(FILES["robot.yaml"].replace("type: wave", "type: swing"))
    assert fresh("dxlrun check robot.yaml", package).returncode == 0
    (package / "my_second.py").write_text(FILES["my_robotics.py"].replace('"wave"', '"second"'))
    project.write_text(FILES["pyproject.toml"] + 'my_second = "my_second"\n')
    robot.write_text(FILES["robot.yaml"].replace("type: wave", "type: second"))
    told = fresh("dxlrun check robot.yaml", package)
    assert (told.returncode, "no plug-in offers the controller type second" in told.stderr) == (2, True)
    assert fresh(install, package).returncode == 0
    assert fresh("dxlrun check robot.yaml", package).returncode == 0
    fresh("pip uninstall --yes my-robotics", package)


def test_the_contract_of_the_page_is_the_contract() -> None:
    assert f"This one has contract {CONTRACT_VERSION}." in PAGE
    assert f"return {CONTRACT_VERSION}\n" in FILES["my_robotics.py"]


def test_each_sentence_of_the_table_is_one_that_dxlrun_prints() -> None:
    sentences = re.findall(r"^\| `(.*?)` \|", PAGE.partition("When it does not work")[2], re.MULTILINE)
    assert len(sentences) == 7
    rooms = ROOT / "runtime/dxlrun"
    said = [
        *rooms.glob("control/controllers/*.py"),
        *rooms.glob("compile/controllers.py"),
        *ROOT.glob("tests/plugins/test_errors.py"),
    ]
    text = re.sub(r'"\s+f?"', "", "".join(path.read_text() for path in said))
    for sentence in sentences:
        for part in filter(None, re.split(r"\.\.\.|\d|\(\)", sentence)):
            assert part.strip(" ;()") in text, sentence
