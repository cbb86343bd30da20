from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from dxlrun.cli import main


class Said(NamedTuple):
    code: int
    out: str
    err: str

    @property
    def errors(self) -> list[str]:
        return self.err.splitlines()


@pytest.fixture
def dxlrun(capsys: pytest.CaptureFixture[str]) -> Callable[..., Said]:
    """Run a command line in this process."""

    def dxlrun(*words: object) -> Said:
        code = main([str(word) for word in words])
        captured = capsys.readouterr()
        return Said(code, captured.out, captured.err)

    return dxlrun


@pytest.fixture
def torso() -> Path:
    return Path(__file__).parents[2] / "robots" / "bioloid_torso.yaml"


@pytest.fixture
def three_parts() -> Path:
    return Path(__file__).parents[2] / "robots" / "motions" / "three_parts.yaml"
