"""Logs of runs that are known to the last number."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from tests.kit.made_logs import Cycle, Said, Wire, made_log

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Write a log of these cycles, packets and events; return its path."""
    return partial(made_log, tmp_path)


@pytest.fixture(scope="session")
def cycle() -> type[Cycle]:
    return Cycle


@pytest.fixture(scope="session")
def wire() -> type[Wire]:
    return Wire


@pytest.fixture(scope="session")
def said() -> type[Said]:
    return Said
