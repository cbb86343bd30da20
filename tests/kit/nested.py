"""Pytest on made-up files in this process, with the conftest of this suite."""

import contextlib
import io
import os
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[2]


class Ran(NamedTuple):
    """How a run of pytest ended."""

    code: int
    out: str

    @property
    def last(self) -> str:
        return self.out.splitlines()[-1]


def forget_outer_pytest(patch: pytest.MonkeyPatch) -> None:
    """Hide the options of the pytest that runs this from one that runs in it."""
    for name in [name for name in os.environ if name.startswith(("PYTEST", "COV_"))]:
        patch.delenv(name)


def run_pytest(folder: Path, files: dict[str, str], *words: str) -> Ran:
    """Run pytest as in a shell whose directory is a folder with these files, a conftest and its settings."""
    conftest = (ROOT / "tests/conftest.py").read_text()
    settings = '[tool.pytest.ini_options]\nmarkers = ["campaign", "long", "needs"]\n'
    for name, text in {"conftest.py": conftest, "pyproject.toml": settings, **files}.items():
        (folder / name).write_text(text)
    modules, path, here = dict(sys.modules), [*sys.path], Path.cwd()
    with pytest.MonkeyPatch.context() as patch:
        forget_outer_pytest(patch)
        patch.setenv("PYTHONPATH", str(ROOT))  # of workers
        patch.chdir(folder)
        output = io.StringIO()
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            code = pytest.main(["-q", "-p", "no:cacheprovider", "-p", "no:timeout", *words])
    for name in [name for name in sys.modules if name not in modules]:
        file = getattr(sys.modules[name], "__file__", None)
        if file is not None and Path(file).is_relative_to(folder):
            del sys.modules[name]
    sys.modules |= {name: module for name, module in modules.items() if name == "conftest"}
    sys.path[:] = path
    assert Path.cwd() == here
    return Ran(int(code), output.getvalue())
