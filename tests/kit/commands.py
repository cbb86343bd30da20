"""Commands: a command line run in this process, and what it said."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import pytest

from dxlrun.cli import main


class Said(NamedTuple):
    """Exit code and output of a command."""

    code: int
    out: str
    err: str

    @property
    def errors(self) -> list[str]:
        return self.err.splitlines()


Dxlrun = Callable[..., Said]


def command_line(capsys: pytest.CaptureFixture[str]) -> Dxlrun:
    """Return what runs `dxlrun` with some words."""

    def dxlrun(*words: object) -> Said:
        code = main([str(word) for word in words])
        captured = capsys.readouterr()
        return Said(code, captured.out, captured.err)

    return dxlrun
