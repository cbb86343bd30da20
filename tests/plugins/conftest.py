"""A fresh environment with dxlrun and the example, as a stranger gets them from an index."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "plugins" / "example"
Shell = Callable[..., "subprocess.CompletedProcess[str]"]


def bash(
    line: str, directory: Path, path: Path, *, isolated: bool = False
) -> subprocess.CompletedProcess[str]:
    """Run one line with `path` before all other programs, far from this interpreter's own settings.

    isolated: pip builds in an environment that it fills from an index each time, as it does by itself;
    without it the hatchling that is there builds (and `editables`, which it asks for).
    """
    ours = ("PYTHON", "PYTEST", "COV_")
    outside = {name: value for name, value in os.environ.items() if not name.startswith(ours)}
    environment = outside | {"PATH": f"{path}:{os.environ['PATH']}", "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    if not isolated:
        environment |= {"PIP_NO_BUILD_ISOLATION": "0"}  # the value of the option: no isolation
    return subprocess.run(
        ["/bin/bash", "-c", line], cwd=directory, env=environment, capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="session")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with the wheels of dxlrun and of the example."""
    directory = tmp_path_factory.mktemp("wheels")
    built = bash(
        f"{sys.executable} -m pip wheel -qq --no-build-isolation --no-deps --wheel-dir . {ROOT} {EXAMPLE}",
        directory,
        Path(sys.executable).parent,
    )
    assert built.returncode == 0, built.stderr
    return directory


@pytest.fixture(scope="session")
def fresh(wheels: Path, tmp_path_factory: pytest.TempPathFactory) -> Shell:
    """Return a function that runs a line in an environment that knows only the two wheels and pytest."""
    environment = tmp_path_factory.mktemp("fresh") / "venv"
    ours, theirs = next(wheels.glob("dxlrun-*.whl")), next(wheels.glob("dxlrun_easing-*.whl"))
    needed = f"hatchling editables {ours} '{theirs}[test]'"
    make = f"{sys.executable} -m venv --clear {environment}"
    make += f" && {environment}/bin/pip install --quiet --no-compile {needed}"
    if uv := os.environ.get("UV"):  # a second of a processor instead of fifteen
        by_uv = f"{uv} venv --quiet --seed --python {sys.executable} {environment}"
        by_uv += f" && {uv} pip install --quiet --python {environment} {needed}"
        make = f"({by_uv}) || ({make})"
    made = bash(make, wheels, Path(sys.executable).parent)
    assert made.returncode == 0, made.stderr

    def shell(line: str, directory: Path, *, isolated: bool = False) -> subprocess.CompletedProcess[str]:
        return bash(line, directory, environment / "bin", isolated=isolated)

    return shell
