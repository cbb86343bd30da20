"""Projects of packages of strangers, as a user would write them."""

from collections.abc import Callable
from pathlib import Path

import pytest

PLUGIN = """\
from dxlrun.tooling.features import Feature


def dxlrun_features():
    return [Feature({name!r}, 'dxlrun_{name}')]
"""


@pytest.fixture(autouse=True)
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def project(tmp_path: Path) -> Callable[..., Path]:
    """Return what writes a project with the feature NAME in `dxlrun_NAME`, which has these modules."""

    def write(name: str, **modules: str) -> Path:
        folder = tmp_path / f"project_{name}"
        package = folder / "src" / f"dxlrun_{name}"
        package.mkdir(parents=True)
        texts = {"__init__": "", "plugin": PLUGIN.format(name=name)} | modules
        for module, text in texts.items():
            (package / f"{module}.py").write_text(text)
        (folder / "pyproject.toml").write_text(
            f'[project]\nname = "dxlrun-{name}"\nversion = "1.0"\n'
            f'[project.entry-points.dxlrun]\n{name} = "dxlrun_{name}.plugin"\n'
        )
        return folder

    return write


@pytest.fixture
def robot_file(tmp_path: Path) -> Callable[[str], Path]:
    """Return what writes the text of a robot file."""

    def write(text: str) -> Path:
        (tmp_path / "robot.yaml").write_text(text)
        return tmp_path / "robot.yaml"

    return write
