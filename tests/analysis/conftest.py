"""Logs of runs that are known to the last number."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from tests.kit.made_logs import made_log


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Write a log of these cycles, packets and events; return its path."""
    return partial(made_log, tmp_path)
