"""Fixtures of runs: real ones of tests/kit/live_run.py, and what controllers do in their updates."""

from collections.abc import Callable
from typing import Any

import pytest
from tests.kit.live_run import live_runs, start  # noqa: F401  fixtures

from dxlrun_controllers.group import JointGroupPositionController


@pytest.fixture
def acts(monkeypatch: pytest.MonkeyPatch) -> dict[str, Callable[[Any, int], object]]:
    """What group controllers of positions do in their updates, by name."""
    found: dict[str, Callable[[Any, int], object]] = {}

    def update(controller: Any, time_ns: int, period_ns: int) -> None:
        if act := found.get(controller.context.name):
            act(controller, time_ns)

    monkeypatch.setattr(JointGroupPositionController, "update", update)
    return found
